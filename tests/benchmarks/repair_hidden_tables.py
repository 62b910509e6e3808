"""Tables of the study of hidden effects: what was named, how the repaired models predict, what was added besides."""

import numpy as np

MAY_BE_WORSE = 0.02  # of chi2/N on fresh data
SEPARATED = 3.3  # d below which an effect is in the class


def key_of(name):
    """(effect, port) of a piece or place."""
    effect, _, port = name.split(", ")[0].partition(" at ")
    return effect, port


def with_nested(name, theory):
    """Theory's word with the laws that hold another one as a special case: a load step at the record's start is a
    constant torque at that port, so that it is no farther from the truth, wherever its refits ended."""
    effect, port = key_of(name)
    rivals = dict(theory["by refits"]["rivals"])
    constant = {key.partition("/")[0]: d for key, d in rivals.items() if key.endswith("/constant_torque")}
    if effect == "constant_torque":
        constant[port] = 0.0
    for at, d in constant.items():
        if (effect, port) != ("load_step", at):
            rivals[f"{at}/load_step"] = min(d, rivals.get(f"{at}/load_step", d))
    least = min(rivals.values(), default=float("inf"))
    count = 1 + sum(d < SEPARATED for d in rivals.values())
    refits = theory["by refits"] | {"rivals": rivals, "class": count, "d": least}
    separable = theory["separable"] and least >= theory["d"]
    return theory | {"by refits": refits, "theory": count, "d": least, "separable": separable}


def judged(name, row):
    """What counts of a row: named alone, inside a class that theory allows, wrong alone, added besides."""
    truth = list(key_of(name))
    found = row["effects"]
    hit = next((one for one in found if truth in one["members"]), None)
    single = hit is not None and len(hit["members"]) == 1

    def inside(theory):
        return single or (hit is not None and len(hit["members"]) <= 1.5 * row[theory]["class"])

    return {
        "good": inside("by refits"),
        "good at optimum": inside("at optimum"),
        "good at truth": inside("at truth"),
        "single right": single,
        "single wrong": any(len(one["members"]) == 1 and one["members"] != [truth] for one in found),
        "nothing": not found,
        "companions": len(found) - (hit is not None),
        "fresh": row["after"]["fresh chi2/N"] <= (1 + MAY_BE_WORSE) * row["true"]["fresh chi2/N"],
        "white": row["after"]["passed"],
        "white fresh": row["after"]["fresh passed"],
        "beside errors": row["after"].get("fresh beside errors"),
        "true white": row["true"]["passed"] and row["true"]["fresh passed"],
        "z": None if row["amplitude"] is None else row["amplitude"]["z"],
        "true z": row["true"]["z"],
    }


def share(hits, of):
    """``hits/of = percent``."""
    return f"{hits}/{of}" + (f" = {100 * hits / of:.1f} %" if of else "")


def naming(rows):
    """Columns of Show 3."""
    n = len(rows)
    apart = [(r, j) for r, j in rows if r["separable"]]
    return [
        str(n),
        share(sum(j["good"] for _, j in rows), n),
        share(sum(j["good at optimum"] for _, j in rows), n),
        share(sum(j["good at truth"] for _, j in rows), n),
        share(sum(j["single wrong"] for _, j in rows), n),
        share(sum(j["nothing"] for _, j in rows), n),
        share(sum(j["single right"] for _, j in apart), len(apart)),
        f"{np.mean([j['companions'] for _, j in rows]):.2f}",
    ]


def proving(rows):
    """Columns of Show 4."""
    n = len(rows)
    z = np.array([j["z"] for _, j in rows if j["z"] is not None])
    true = np.array([j["true z"] for _, j in rows if j["true z"] is not None])
    beside = [j["beside errors"] for _, j in rows if j["beside errors"] is not None]
    worse = [r["after"]["fresh chi2/N"] / r["true"]["fresh chi2/N"] - 1 for r, _ in rows]
    return [
        str(n),
        share(sum(j["fresh"] for _, j in rows), n),
        f"{100 * np.median(worse):+.2f} %",
        share(sum(j["white"] for _, j in rows), n),
        share(sum(j["white fresh"] for _, j in rows), n),
        share(sum(beside), len(beside)),
        share(sum(j["true white"] for _, j in rows), n),
        share(int(np.sum(np.abs(z) < 1.96)), len(z)),
        f"{np.mean(z):+.2f} ± {np.std(z):.2f}" if len(z) else "-",
        share(int(np.sum(np.abs(true) < 1.96)), len(true)),
    ]


NAMING = (
    "records | named right, or in a class at most 1.5 times theory's | the same, theory by slopes at the optimum"
    " | by slopes at the truth | a single wrong name | nothing named | separable: single right name"
    " | added besides, mean"
)
PROVING = (
    "records | fresh chi2/N within 2 % of the true structure's | median of what it is more | residual tests passed"
    " | on fresh data | on fresh data, beside errors of the parameters | true structure: both passed"
    " | 95 % interval covers | z of the size, mean ± sd | true structure's covers"
)


def table(groups, columns, first, header):
    """Markdown of groups : words -> rows."""
    count = first.count("|") + header.count("|") + 2
    out = [f"| {first} | {header} |", "|" + "---|" * count]
    out += [f"| {words} | {' | '.join(columns(rows))} |" for words, rows in groups.items() if rows]
    return "\n".join(out)


def tables(done, theory, untestable):
    """All tables of the rows that are done; theory : "place, sensors, times" -> what it allows."""
    place = {n: n.rpartition(", ")[0] for n in done}
    theory = {n: with_nested(n, word) for n, word in theory.items()}
    whole = {n: r | theory[place[n]] for n, r in done.items() if "failed" not in r and place[n] in theory}
    pairs = {name: (row, judged(name, row)) for name, row in whole.items()}
    if not pairs:
        return "nothing is done"
    sized, effects = {}, {}
    for name, pair in pairs.items():
        _, sensors, times, _ = name.rsplit(", ", 3)
        sized.setdefault(f"{sensors} | {times} x", []).append(pair)
        effects.setdefault(key_of(name)[0], []).append(pair)
    sized = dict(sorted(sized.items())) | {"all | ": list(pairs.values())}
    effects = dict(sorted(effects.items()))
    out = [table(sized, naming, "sensors | size", NAMING), table(effects, naming, "effect", NAMING)]
    out += [table(sized, proving, "sensors | size", PROVING), table(effects, proving, "effect", PROVING)]
    differ = [n for n, (r, _) in pairs.items() if r["by refits"]["class"] != r["at optimum"]["class"]]
    cpu = [row["cpu"] for row, _ in pairs.values()]
    out.append(
        f"{np.median(cpu):.1f} s CPU a repair (median), {np.max(cpu):.1f} s at most; theory's class by refits"
        f" is not as large as by slopes at the optimum in {share(len(differ), len(pairs))} of the records"
    )
    out.append(
        "Missed:\n\n" + "\n".join(missed(name, *pair) for name, pair in pairs.items() if not pair[1]["good"])
    )
    without = [n for n, r in done.items() if "failed" not in r and place[n] not in theory]
    if without:
        out.append(f"Not counted, since theory's word is missing: {len(without)} records")
    broken = [f"- {name}: {row['failed']}" for name, row in done.items() if "failed" in row]
    if broken:
        out.append("Errors, not counted above:\n\n" + "\n".join(broken))
    if untestable:
        out.append(
            "Not testable here:\n\n" + "\n".join(f"- {name} x: {why}" for name, why in untestable.items())
        )
    return "\n\n".join(out)


def missed(name, row, _):
    """One line on a miss."""
    said = "; ".join(" or ".join(f"{n} at {at}" for n, at in one["members"][:4])
                     + (f" and {len(one['members']) - 4} more" if len(one["members"]) > 4 else "")
                     for one in row["effects"]) or row["verdict"]  # fmt: skip
    bound = f", at bounds {', '.join(row['null']['at_bound'])}" if row["null"]["at_bound"] else ""
    return (
        f"- {name}: {said} (chi2/N {row['null']['chi2/N']:.3f} before{bound}, {row['after']['chi2/N']:.3f} after,"
        f" true {row['true']['chi2/N']:.3f}; mu {row['mu']:.3g}, d {row['d']:.2g}, theory's class {row['theory']})"
    )
