"""The symbols of units and their prefixes, and what was probably meant by one that is not known."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, lru_cache

BASE = ("s", "m", "kg", "A", "K", "mol", "cd", "rad")

_PREFIXES = {
    "p": -12, "n": -9, "u": -6, "\u00b5": -6, "\u03bc": -6, "m": -3, "c": -2, "d": -1, "h": 2, "k": 3, "M": 6, "G": 9,
    "T": 12,
}  # fmt: skip

# symbol -> powers of BASE; each takes prefixes (kg is g with one)
_COHERENT = {
    "s": (1,), "m": (0, 1), "A": (0, 0, 0, 1), "K": (0, 0, 0, 0, 1), "mol": (0, 0, 0, 0, 0, 1),
    "cd": (0, 0, 0, 0, 0, 0, 1), "rad": (0, 0, 0, 0, 0, 0, 0, 1), "Hz": (-1,), "N": (-2, 1, 1),
    "Pa": (-2, -1, 1), "J": (-2, 2, 1), "W": (-3, 2, 1), "V": (-3, 2, 1, -1),
    "Ohm": (-3, 2, 1, -2), "S": (3, -2, -1, 2), "Wb": (-2, 2, 1, -1), "T": (-2, 0, 1, -1),
    "H": (-2, 2, 1, -2),
}  # fmt: skip

# symbol -> (SI symbols with powers, factor, power of pi, offset, takes prefixes)
_OTHERS: dict[str, tuple[str, str, int, str, bool]] = {
    # not C and F themselves: a record in "C" is one of a temperature more often than not
    "C": ("A s", "1", 0, "0", True), "F": ("A s V-1", "1", 0, "0", True),
    "g": ("kg", "1/1000", 0, "0", True), "t": ("kg", "1000", 0, "0", False), "L": ("m3", "1/1000", 0, "0", True),
    "bar": ("Pa", "100000", 0, "0", True), "atm": ("Pa", "101325", 0, "0", False),
    "mmHg": ("Pa", "133.322387415", 0, "0", False), "cmH2O": ("Pa", "98.0665", 0, "0", False),
    "mmH2O": ("Pa", "9.80665", 0, "0", False), "psi": ("Pa", "6894.757293168361", 0, "0", False),
    "min": ("s", "60", 0, "0", False), "h": ("s", "3600", 0, "0", False), "d": ("s", "86400", 0, "0", False),
    "rpm": ("rad s-1", "1/30", 1, "0", False), "rev": ("rad", "2", 1, "0", False),
    "deg": ("rad", "1/180", 1, "0", False), "gon": ("rad", "1/200", 1, "0", False),
    "degC": ("K", "1", 0, "273.15", False),
    "degF": ("K", "5/9", 0, "45967/180", False), "%": ("", "1/100", 0, "0", False),
    "ppm": ("", "1/1000000", 0, "0", False), "M": ("mol m-3", "1000", 0, "0", True),
    "gn": ("m s-2", "9.80665", 0, "0", False), "in": ("m", "0.0254", 0, "0", False),
    "ft": ("m", "0.3048", 0, "0", False), "mi": ("m", "1609.344", 0, "0", False),
    "lb": ("kg", "0.45359237", 0, "0", False), "lbf": ("N", "4.4482216152605", 0, "0", False),
    "cal": ("J", "4.184", 0, "0", True), "Wh": ("J", "3600", 0, "0", True), "Ah": ("A s", "3600", 0, "0", True),
    "eV": ("J", "1.602176634e-19", 0, "0", True), "PS": ("W", "735.49875", 0, "0", False),
}  # fmt: skip
_SAME = {
    "l": "L", "\u03a9": "Ohm", "\u2126": "Ohm", "ohm": "Ohm", "°": "deg", "°C": "degC", "°F": "degF", "grad": "gon",
}  # fmt: skip
_CLOCKS = ("min", "h", "d")

# Long names and wrong spellings that have one meaning.
_MEANT = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "minute": "min", "minutes": "min", "mins": "min",
    "hr": "h", "hrs": "h", "hour": "h", "hours": "h", "day": "d", "days": "d", "meter": "m", "metre": "m",
    "celsius": "degC", "kelvin": "K", "degk": "K", "fahrenheit": "degF", "liter": "L", "litre": "L", "ltr": "L",
    "ohms": "Ohm", "volt": "V", "volts": "V", "ampere": "A", "amp": "A", "amps": "A", "watt": "W", "newton": "N",
    "pascal": "Pa", "joule": "J", "hertz": "Hz", "radian": "rad", "radians": "rad", "degree": "deg",
    "degrees": "deg", "revs": "rev", "revolutions": "rev", "turns": "rev", "gram": "g", "grams": "g", "gr": "g",
    "kgs": "kg", "cc": "cm3", "ccm": "cm3", "kph": "km/h", "kmh": "km/h", "mps": "m/s", "kmph": "km/h",
    "mph": "mi/h", "gpm": "L/min", "lpm": "L/min", "rps": "rev/s", "percent": "%", "none": "1",
    "dimensionless": "1", "unitless": "1", "torr": "mmHg", "hp": "PS",
}  # fmt: skip
# Symbols that are often written together.
_JOINED = {
    "Nm": "N m", "Nms": "N m s", "Nmm": "N mm", "Ncm": "N cm", "mNm": "mN m", "kNm": "kN m", "MNm": "MN m",
    "Ns": "N s", "kgm": "kg m", "gm": "g m", "Pas": "Pa s", "mPas": "mPa s", "Js": "J s", "As": "A s", "Vs": "V s",
    "Ws": "W s",
}  # fmt: skip


@dataclass(frozen=True)
class Symbol:
    """One symbol: base powers, SI symbols with powers in their place, factor, power of pi, offset.

    clock : the symbol if it is a time other than s, else empty.
    """

    exponents: tuple[tuple[str, Fraction], ...]
    si: tuple[tuple[str, Fraction], ...]
    factor: Fraction
    pi: int
    offset: Fraction
    clock: str


def _plain(name: str) -> Symbol:
    powers = tuple((base, Fraction(p)) for base, p in zip(BASE, _COHERENT[name], strict=False) if p)
    return Symbol(powers, ((name, Fraction(1)),), Fraction(1), 0, Fraction(0), "")


def _other(name: str) -> Symbol:
    text, factor, pi, offset, _ = _OTHERS[name]
    si: list[tuple[str, Fraction]] = []
    exponents: dict[str, Fraction] = {}
    for part in text.split():
        plain = part.rstrip("-0123456789")
        power = Fraction(part[len(plain) :] or 1)
        si.append((plain, power))
        base = ((plain, Fraction(1)),) if plain in BASE else _plain(plain).exponents
        exponents.update({key: exponents.get(key, Fraction(0)) + own * power for key, own in base})
    clock = name if name in _CLOCKS else ""
    return Symbol(tuple(exponents.items()), tuple(si), Fraction(factor), pi, Fraction(offset), clock)


@lru_cache(maxsize=1024)
def symbol_of(text: str) -> Symbol | None:
    """The symbol, with a prefix or without; None if there is none of that name.

    >>> symbol_of("kPa").factor, symbol_of("KPA")
    (Fraction(1000, 1), None)
    """
    name = _SAME.get(text, text)
    if name in _COHERENT:
        return _plain(name)
    if name in _OTHERS:
        return _other(name)
    for prefix, power in _PREFIXES.items():
        rest = name[len(prefix) :]
        rest = _SAME.get(rest, rest)
        takes = rest in _COHERENT or (rest in _OTHERS and _OTHERS[rest][4])
        if rest == "M" and power > -3:
            takes = False  # MM is a slip of the pen, not a megamole per litre
        if name.startswith(prefix) and takes:
            whole = _plain(rest) if rest in _COHERENT else _other(rest)
            size = Fraction(10) ** power
            return Symbol(
                whole.exponents,
                whole.si,
                whole.factor * size,
                whole.pi,
                whole.offset,
                text if rest == "s" else "",
            )
    return None


@cache
def _spellings() -> dict[str, tuple[str, ...]]:
    """All symbols, bare and with usual prefixes, by their lower-case spelling."""
    bare = [*_COHERENT, *_OTHERS, "kg"]
    able = [*_COHERENT, *(name for name, row in _OTHERS.items() if row[4])]
    found: dict[str, tuple[str, ...]] = {}
    for name in [*bare, *(prefix + name for prefix in "kMmunG" for name in able)]:
        if symbol_of(name) is not None and name not in found.get(name.lower(), ()):
            found[name.lower()] = (*found.get(name.lower(), ()), name)
    return found


def suggestion(text: str, word: str) -> str:
    """What to do about an unknown symbol: only another spelling of the same unit is ever suggested."""
    meant = _respelt(word)
    if not meant:
        return "convert the data to an SI unit, or correct the symbol"
    whole = " ".join(text.split())
    at = whole.find(word)
    end = at + len(word)
    if (
        whole[:at].rstrip().endswith("/")
    ):  # a product behind a slash goes into brackets, with the power of its end
        while end < len(whole) and whole[end] in "0123456789^²³":
            end += 1
        meant = [f"({one}{whole[at + len(word) : end]})" if {" ", "/"} & set(one) else one for one in meant]
        end = end if meant[0].startswith("(") else at + len(word)
    return f"did you mean {' or '.join(repr(whole[:at] + one + whole[end:]) for one in meant)}?"


def _respelt(word: str) -> list[str]:
    if word in _JOINED:
        return [_JOINED[word]]
    if word.lower() in _MEANT:
        return [_MEANT[word.lower()]]
    same = [one for one in _spellings().get(word.lower(), ()) if one != word]
    if same:
        return same[:3]
    for at in range(1, len(word)):
        first, second = word[:at], word[at:]
        if symbol_of(first) is not None and symbol_of(second) is not None:
            if first == second:  # a key that was hit twice
                return [first]
            plural = [first] if second == "s" and len(word) > 2 else []
            return [*plural, f"{first} {second}"]
    near = difflib.get_close_matches(word.lower(), [*_spellings(), *_MEANT], n=1, cutoff=0.8)
    if near and len(word) > 3:
        return [_MEANT[near[0]]] if near[0] in _MEANT else list(_spellings()[near[0]][:2])
    return []
