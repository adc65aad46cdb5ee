"""The report of ``benchmarks.speed``: tables (Markdown), a plot, and the numbers themselves (JSON)."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sb3_tdc.common.plots import style_axes

_TDC = "TDC"
_OTHER_PAIRS = ("SB3 TD3 / TDC, readable update", "SB3 SAC / TDC, stochastic head")


def ratios(times: list[float], reference: list[float]) -> np.ndarray:
    """Return (rounds,), each time divided by the reference's time of the same round."""
    return np.asarray(times) / np.asarray(reference)


def quartiles(values: np.ndarray) -> str:
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"**{middle:.2f}** ({low:.2f}–{high:.2f})"


def table_of_env(results: dict[str, Any], targets: dict[tuple[str, int], float]) -> list[str]:
    """Return a table of the time of each peer (rows) over that of TDC, by number of threads (columns)."""
    threads = list(results)
    header = [
        "peer",
        *(f"ratio, {n} thread{'s' * (n != '1')}" for n in threads),
        "target",
        *(f"ms, {n}t" for n in threads),
    ]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for peer in [*results[threads[0]]["steps"], *_OTHER_PAIRS]:
        numerator, _, denominator = peer.partition(" / ")
        cells = [peer]
        for n in threads:
            steps = results[n]["steps"]
            cells.append("1" if peer == _TDC else quartiles(ratios(steps[numerator], steps[denominator or _TDC])))
        cells.append(", ".join(f"{targets[peer, int(n)]} ({n}t)" for n in threads if (peer, int(n)) in targets))
        cells += ["" if denominator else f"{np.median(results[n]['steps'][peer]):.1f}" for n in threads]
        lines.append("| " + " | ".join(cells) + " |")
    gradient = [results[n]["gradient"] for n in threads]
    cells = ["gradient step / its matrix products alone"]
    cells += [quartiles(ratios(g[_TDC], g["matrix products"])) for g in gradient]
    cells += ["≤ 1.6 (2t), ≤ 1.45 (1t)", *(f"{np.median(g[_TDC]):.1f}" for g in gradient)]
    lines.append("| " + " | ".join(cells) + " |")
    load = ", ".join(f"{results[n]['foreign_load']:.2f} ({n}t)" for n in threads)
    return [*lines, "", f"Load by other processes meanwhile, in cores: {load}."]


def table_of_runs(together: list[dict[str, Any]]) -> list[str]:
    """Return a table of the steps per second of all runs together, by number of runs and threads."""
    lines = ["| runs at once | threads each | steps/s of all together (each turn) |", "|---|---|---|"]
    for row in together:
        turns = ", ".join(f"{rate:.0f}" for rate in row["rates"])
        lines.append(f"| {row['runs']} | {row['threads']} | **{np.median(row['rates']):.0f}** ({turns}) |")
    return lines


def draw_scaling(scaling: dict[str, Any], path: Path) -> None:
    """Draw the milliseconds of a gradient step and of its matrix products, against quantiles, batch size and width."""
    from matplotlib.figure import Figure

    kinds = [kind for kind in next(iter(scaling.values())) if kind != "foreign_load"]
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    for axes, kind in zip(figure.subplots(1, len(kinds)), kinds, strict=True):
        for threads, result in scaling.items():
            sizes = list(map(int, result[kind]))
            for name, style in ((_TDC, "o-"), ("matrix products", "x:")):
                medians = [np.median(times[name]) for times in result[kind].values()]
                axes.plot(sizes, medians, style, color=f"C{int(threads) - 1}", label=f"{name}, {threads}t", ms=4)
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
        axes.minorticks_off()
        style_axes(axes, "", kind, "ms per gradient step")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def write_report(results: dict[str, Any], folder: Path, targets: dict[tuple[str, int], float]) -> None:
    """Write ``speed.md``, ``speed.json`` and ``scaling.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "speed.json").write_text(json.dumps(results))
    draw_scaling(results["scaling"], folder / "scaling.png")
    arguments = f"--rounds {results['rounds']} --seconds {results['seconds']}"
    lines = [
        "# Speed",
        "",
        f"Made by `python -m benchmarks.speed {arguments}`; do not edit.",
        "",
        f"{results['hardware']}. Whole environment steps (simulator, replay, one gradient step of batch 256, 256-256"
        " networks, float32), one gradient step a step. A ratio is the peer's time over TDC's (64 quantiles, fused"
        f" update, deterministic head), where no other is named; median (quartiles) of"
        f" {results['rounds']} turns of {results['seconds']} s, taken in turn in one process, in another order each"
        " time, a few steps after each change. *2t*, *1t*: on two"
        " threads, on one thread of one core. *target*: set"
        " beforehand, for HalfCheetah-v4.",
        "",
    ]
    for env_id, by_threads in results["envs"].items():
        lines += [f"## {env_id}", "", *table_of_env(by_threads, targets if "Cheetah" in env_id else {}), ""]
    lines += [
        "## Runs at once",
        "",
        "TDC on HalfCheetah-v4, on all cores.",
        "",
        *table_of_runs(results["together"]),
        "",
        "## Cost against quantiles, batch size and width",
        "",
        "Gradient steps on HalfCheetah-v4, all else as above, next to their matrix products alone (dotted).",
        "",
        "![Cost of a gradient step](scaling.png)",
        "",
        f"The whole benchmark took {results['minutes']:.0f} minutes.",
    ]
    (folder / "speed.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
