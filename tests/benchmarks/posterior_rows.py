"""The finished rows of the posterior's study, kept small in the repository: `posterior_rows/NAME.json`.

A study goes on from them on any machine, and the table is written from them. A row is a list of numbers:
seed, ranks (draws below the truth, of all), rank of the truth's log density (or null), z of the fit's standard errors
in hundredths (or null), processor seconds of the posterior, evaluations, modes, 1 if walkers drew. One that was refused
is its seed, its seconds and why. Rows stand under the version of the package that made them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import casadi_engine as ce

Row = dict[str, Any]
FOLDER = "posterior_rows"
# What `Posterior.why` says of draws without walkers.
FEW = "few smooth optima"


class Kept:
    """The rows of one variant in a folder.

    rows : seed -> row, as `posterior_study.row` makes it but for what is not kept
    Rows of another setting are not taken in: they were made by another study.
    """

    def __init__(self, folder: Path, name: str, setting: dict[str, Any]) -> None:
        self._path, self._setting = folder / FOLDER / f"{name}.json", setting
        self._names: list[str] = []
        self._versions: dict[int, str] = {}
        self.rows: dict[int, Row] = {}
        if not self._path.exists():
            return
        found = json.loads(self._path.read_text("utf-8"))
        if found["setting"] != setting:
            return
        self._names = found["names"]
        for version, lists in found["rows"].items():
            for one in lists:
                self.rows[one[0]] = self._long(one)
                self._versions[one[0]] = version

    def add(self, rows: dict[int, Row]) -> None:
        """Take in rows that are not there yet, and write the file."""
        new = {seed: row for seed, row in rows.items() if seed not in self.rows}
        for seed, row in sorted(new.items()):
            self._names = self._names or list(row["z"])
            self.rows[seed] = self._long(self._short(seed, row))
            self._versions[seed] = ce.__version__
        if new:
            self._write()

    def _write(self) -> None:
        groups = []
        for version in sorted(set(self._versions.values())):
            lines = [
                json.dumps(self._short(seed, self.rows[seed]), separators=(",", ":"))
                for seed in sorted(self.rows)
                if self._versions[seed] == version
            ]
            groups.append(f"{json.dumps(version)}: [\n" + ",\n".join(lines) + "\n]")
        head = f'{{"setting": {json.dumps(self._setting)}, "names": {json.dumps(self._names)}, "rows": {{'
        self._path.parent.mkdir(parents=True, exist_ok=True)
        part = self._path.with_suffix(".part")
        part.write_text(head + ", ".join(groups) + "}}\n", "utf-8")
        part.replace(self._path)

    def _short(self, seed: int, row: Row) -> list[Any]:
        if "refused" in row:
            return [seed, round(row["seconds"], 1), row["refused"].splitlines()[0]]
        draws = self._setting["draws"]
        z = [None if one is None else round(100 * one) for one in (row["z"][name] for name in self._names)]
        return [
            seed,
            [round(draws * row["rank"][name]) for name in self._names],
            None if row.get("height") is None else round(row["height"], 3),
            None if all(one is None for one in z) else z,
            round(row["seconds"], 1),
            row["evaluations"],
            row["modes"],
            int(row["why"] != FEW),
        ]

    def _long(self, one: list[Any]) -> Row:
        if len(one) == 3:
            return {"seconds": one[1], "refused": one[2], "z": {}}
        _, ranks, height, z, seconds, evaluations, modes, walked = one
        z = z or [None] * len(self._names)
        return {
            "rank": {
                name: rank / self._setting["draws"] for name, rank in zip(self._names, ranks, strict=True)
            },
            "height": height,
            "z": {name: own if own is None else own / 100 for name, own in zip(self._names, z, strict=True)},
            "seconds": seconds,
            "evaluations": evaluations,
            "modes": modes,
            "why": "walkers" if walked else FEW,
        }
