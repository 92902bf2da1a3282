"""Studies: many models, one CSV each, and the table that a CSV says.

    python -m minicmdm.evaluation.studies vae|masks|objective|sampling|grid  small models with seeds (small.py)
    python -m minicmdm.evaluation.studies guidance                           the shipped systems (small.py)
    python -m minicmdm.evaluation.studies agreement|hearing|dimensions       what the judges hear (spoilt.py)
    python -m minicmdm.evaluation.studies reading                            what the frozen words say (reading.py)
    python -m minicmdm.evaluation.studies drift|reaction                     streams, an hour long (drift.py)

Each row is written as soon as it is measured, and rows that are there already are not measured again: a study that was
stopped goes on. The CSVs of the project are in minicmdm/assets/studies, and `--print` shows what they say.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from scipy import stats

from minicmdm.evaluation import drift, reading, small, spoilt
from minicmdm.evaluation.small import Row
from minicmdm.pipeline import ASSETS

STUDIES = ASSETS / "studies"
ROWS = {
    "vae": small.vae_rows,
    "masks": small.mask_rows,
    "objective": small.objective_rows,
    "sampling": small.sampling_rows,
    "grid": small.grid_rows,
    "guidance": small.guidance_rows,
    "agreement": spoilt.agreement_rows,
    "hearing": spoilt.hearing_rows,
    "dimensions": spoilt.dimension_rows,
    "reading": reading.reading_rows,
    "drift": drift.drift_rows,
    "reaction": drift.reaction_rows,
}


# The same models asked in two ways: compared seed by seed, since the same seeds err together in some of the numbers.
PAIRS = {"sampling": [("fss 20 2", "autoregressive 20 20"), ("fss 20 1", "fss 20 10"), ("fss 50 5", "fss 20 2")]}


def run(name: str, folder: Path, scratch: Path) -> list[Row]:
    """Measure what `folder`/NAME.csv lacks, row by row; return all rows."""
    path, done = folder / f"{name}.csv", read(name, folder)
    folder.mkdir(parents=True, exist_ok=True)
    for label, measure in ROWS[name](scratch):
        if any(all(str(row[key]) == str(value) for key, value in label.items()) for row in done):
            continue
        done.append({**label, **{key: float(f"{value:.5g}") for key, value in measure().items()}})
        print(done[-1], flush=True)
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, done[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows(done)
    return read(name, folder)  # as text, whether measured now or before


def read(name: str, folder: Path = STUDIES) -> list[Row]:
    """The rows of a study's CSV, numbers as text; none if it has not been run."""
    path = folder / f"{name}.csv"
    if not path.is_file():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def summary(name: str, rows: list[Row]) -> str:
    """A study in a few lines: means and 95 % intervals over seeds, correlations, or the rows themselves."""
    if "seed" in rows[0]:
        before = list(rows[0]).index("seed")
        labels, keys = list(rows[0])[:before], list(rows[0])[before + 1 :]
        table = [[*labels, *keys]]
        for kind in dict.fromkeys(tuple(row[key] for key in labels) for row in rows):
            same = [row for row in rows if tuple(row[key] for key in labels) == kind]
            table.append([*kind, *(interval([float(row[key]) for row in same]) for key in keys)])
        for one, other in PAIRS.get(name, ()):
            first, second = (
                {row["seed"]: row for row in rows if [str(row[k]) for k in labels] == kind.split()}
                for kind in (one, other)
            )
            seeds = [seed for seed in first if seed in second]
            change = (interval([float(first[s][key]) - float(second[s][key]) for s in seeds]) for key in keys)
            if seeds:  # a study that is under way may lack either
                table.append([f"{one} minus {other}", *[""] * (len(labels) - 1), *change])
    else:
        table = [list(rows[0]), *([row[key] for key in rows[0]] for row in rows)]
    widths = [max(len(str(line[k])) for line in table) for k in range(len(table[0]))]
    lines = ["  ".join(f"{cell!s:>{width}}" for cell, width in zip(line, widths)) for line in table]
    if name == "agreement":
        truth = np.array([float(row["oracle_accuracy"]) for row in rows])
        for key in ("r_at_1", "r_at_3", "fid", "mm_dist", "clip_score"):
            values = np.array([float(row[key]) for row in rows])
            lines.append(f"rank correlation of {key} with oracle accuracy: {correlation(truth, values)}")
    if name == "drift":
        for body in ("minutes", "rigid_minutes"):
            first, *_, last = (key for key in rows[0] if key.startswith(body))
            change = interval([float(row[last]) - float(row[first]) for row in rows])
            lines.append(f"accuracy in {last} minus that in {first}: {change}, over {len(rows)} streams")
    return "\n".join(lines)


def interval(values: list[float]) -> str:
    """Mean ± 95 % interval of a few seeds, by Student's t: with three seeds 1.96 standard errors would be too few."""
    half = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5 if len(values) > 1 else 0.0
    return f"{np.mean(values):.4g} ± {half:.2g}"


def correlation(truth: np.ndarray, values: np.ndarray) -> str:
    """Spearman's rank correlation over models, with the interval of 2,000 bootstrap draws of the models."""
    rng, found = np.random.default_rng(0), []
    for _ in range(2000):
        chosen = rng.integers(len(truth), size=len(truth))
        if len(set(truth[chosen])) > 2 and len(set(values[chosen])) > 2:
            found.append(stats.spearmanr(truth[chosen], values[chosen])[0])
    low, high = np.percentile(found, [2.5, 97.5])
    return f"{stats.spearmanr(truth, values)[0]:+.2f} [{low:+.2f}, {high:+.2f}], {len(truth)} models"


def main() -> None:
    """Run a study and say what it found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=tuple(ROWS))
    parser.add_argument("--out", type=Path, default=STUDIES, help="folder of the CSV")
    parser.add_argument("--scratch", type=Path, default=Path("runs/micro"), help="folder of the models it trains")
    parser.add_argument("--print", action="store_true", help="only say what the CSV holds")
    arguments = parser.parse_args()
    rows = read(arguments.study, arguments.out)
    if not arguments.print:
        rows = run(arguments.study, arguments.out, arguments.scratch)
    print(summary(arguments.study, rows) if rows else f"no rows yet in {arguments.out}")


if __name__ == "__main__":
    main()
