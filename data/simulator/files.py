"""Records as csv.gz files whose bytes depend on nothing but the numbers."""

import gzip
import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .records import CONTRACT
from .run import Start

STARTS = "starts.json"
SETTLED_SHARE = 1e-6  # 1e-4 rad/s of 100 rad/s

# Digits: half a unit in the last place is 5e-13 s, 5e-10 rad, 0.5 Pa (1e-4 N m at most) and 5e-5 rad/s.
DIGITS = {"s": "%.12f", "rad": "%.9f", "Pa": "%.0f", "N m": "%.7g", "rad/s": "%.4f"}
LAST_PLACE = {"s": 1e-12, "rad": 1e-9, "Pa": 1.0, "N m": 1e-5, "rad/s": 1e-4}


def to_text(columns: Mapping[str, np.ndarray]) -> str:
    """The record as CSV text with the header `name [unit]`."""
    header = ",".join(f"{name} [{CONTRACT[name]}]" for name in columns)
    row = ",".join(DIGITS[CONTRACT[name]] for name in columns)
    lines = [row % values for values in zip(*(column.tolist() for column in columns.values()), strict=True)]
    return "\n".join([header, *lines, ""])


def compress(text: str) -> bytes:
    """Gzip without time stamp and file name, so that the same text gives the same bytes."""
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, compresslevel=9, mtime=0) as stream:
        stream.write(text.encode("utf-8"))
    return buffer.getvalue()


def read_columns(content: bytes) -> dict[str, np.ndarray]:
    """Columns of a csv.gz file by their names without the unit."""
    text = gzip.decompress(content).decode("utf-8")
    names = [cell.split(" [")[0] for cell in text[: text.index("\n")].split(",")]
    values = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=1, unpack=True)
    return dict(zip(names, values, strict=True))


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def compare(made: bytes, kept: bytes) -> tuple[bool, str]:
    """Whether two files hold the same record, and how exactly.

    Another processor or another numpy may round the last bit of a tanh differently; then a few numbers differ
    by one unit in their last written place.  Up to two units count as the same record.
    """
    if made == kept:
        return True, "identical bytes"
    if gzip.decompress(made) == gzip.decompress(kept):
        return True, "identical text, compressed by another zlib"
    ours, theirs = read_columns(made), read_columns(kept)
    if list(ours) != list(theirs) or len(ours["time"]) != len(theirs["time"]):
        return False, "other columns or another length"
    worst = {n: float(np.abs(ours[n] - theirs[n]).max()) / LAST_PLACE[CONTRACT[n]] for n in ours}
    name = max(worst, key=lambda n: worst[n])
    return worst[name] < 2.5, f"{name} differs by up to {worst[name]:.1f} units in its last place"


def starts_agree(one: Start, other: Start) -> tuple[bool, str]:
    """Whether two warm-ups came to the same, and how nearly: a warm-up closes within 1e-4 rad/s, with steps of a
    relative 1e-7, which another processor's last bits make otherwise long."""
    half = len(one.state) // 2
    parts = [
        (np.array([a.strength]), np.array(a.state[1 : half + 1]), np.array(a.state[half + 1 :]))
        for a in (one, other)
    ]
    off = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(*parts, strict=True))
    return off < SETTLED_SHARE, f"its warm-up comes within {off:.1e} of the kept one"


def write_starts(folder: Path, starts: Mapping[str, Start]) -> None:
    """What the warm-ups of the records came to, by path: strength and state."""
    listed = {path: [one.strength, *one.state] for path, one in starts.items()}
    (folder / STARTS).write_text(json.dumps(listed, indent=0) + "\n", encoding="utf-8")


def read_starts(folder: Path) -> dict[str, Start]:
    path = folder / STARTS
    if not path.exists():
        return {}
    listed = json.loads(path.read_text(encoding="utf-8"))
    return {name: Start(values[0], tuple(values[1:])) for name, values in listed.items()}


def write_hashes(folder: Path, hashes: Mapping[str, str]) -> None:
    """Hash list in the format of `sha256sum --check`."""
    lines = [f"{digest}  {name}\n" for name, digest in hashes.items()]
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


def read_hashes(folder: Path) -> dict[str, str]:
    path = folder / "SHA256SUMS"
    if not path.exists():
        return {}
    pairs = (line.split("  ", 1) for line in path.read_text(encoding="utf-8").splitlines())
    return {name: digest for digest, name in pairs}
