"""The candidates that a search tries: texts of the command line → hyperparameters. No text is run as code."""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_tdc.common import plain_yaml

# The values of λ in the paper
LAMBDAS = [round(0.1 * i, 1) for i in range(1, 11)]
_DISTRIBUTION = re.compile(r"(\w+)\(([^,()]+),([^,()]+)\)")


@dataclass(frozen=True)
class Distribution:
    """
    A distribution that candidates are drawn from.

    :param kind: "uniform", "loguniform" or "randint"
    :param low: smallest value
    :param high: largest value, included (for "randint" too)
    """

    kind: str
    low: float
    high: float

    def draw(self, random: np.random.Generator) -> float | int:
        """Return a number with three significant digits, which can be typed on a command line."""
        if self.kind == "randint":
            return int(random.integers(int(self.low), int(self.high), endpoint=True))
        if self.kind == "loguniform":
            value = np.exp(random.uniform(np.log(self.low), np.log(self.high)))
        else:
            value = random.uniform(self.low, self.high)
        return float(np.clip(float(f"{value:.3g}"), self.low, self.high))


def parse_space(texts: Sequence[str]) -> dict[str, list[Any] | Distribution]:
    """
    Parse ``["kappa:[1.0, 10.0]", "tau:loguniform(1e-4, 1e-2)"]`` into the values to try of every hyperparameter.

    :raises ValueError: for anything else
    """
    space: dict[str, list[Any] | Distribution] = {}
    for text in texts:
        key, colon, values = (part.strip() for part in text.partition(":"))
        if not (key and colon and values):
            raise ValueError(f"--search {text!r} must be key:[value, ...] or key:loguniform(low, high)")
        if key in space:
            raise ValueError(f"--search names {key} twice")
        match = _DISTRIBUTION.fullmatch(values)
        space[key] = _parse_distribution(text, *match.groups()) if match else _parse_list(text, values)
    return space


def _parse_distribution(text: str, kind: str, *bounds: str) -> Distribution:
    if kind not in ("uniform", "loguniform", "randint"):
        raise ValueError(f"--search {text!r}: {kind} is no distribution; there are uniform, loguniform, randint")
    try:
        low, high = map(float, bounds)
    except ValueError:
        raise ValueError(f"--search {text!r}: the bounds must be numbers") from None
    if not (np.isfinite([low, high]).all() and low < high and (kind != "loguniform" or low > 0)):
        raise ValueError(f"--search {text!r}: the bounds must increase" + ", from above 0" * (kind == "loguniform"))
    if kind == "randint" and not (low.is_integer() and high.is_integer()):
        raise ValueError(f"--search {text!r}: the bounds must be integers")
    return Distribution(kind, low, high)


def _parse_list(text: str, values: str) -> list[Any]:
    try:
        parsed = plain_yaml.load(values, "--search")
    except ValueError:
        parsed = None
    if not isinstance(parsed, list) or not parsed:
        raise ValueError(f"--search {text!r}: the values must be a list, [value, ...], or a distribution")
    return list({str(value): value for value in parsed}.values())


def make_candidates(space: Mapping[str, list[Any] | Distribution], n_samples: int, seed: int = 0) -> list[dict]:
    """
    Make every combination of the lists, each with every one of ``n_samples`` joint draws of the distributions.

    :return: the candidates, without duplicates; the same for the same arguments
    """
    lists = {key: values for key, values in space.items() if isinstance(values, list)}
    drawn = {key: values for key, values in space.items() if isinstance(values, Distribution)}
    random = np.random.default_rng(seed)
    draws = [{key: d.draw(random) for key, d in drawn.items()} for _ in range(n_samples if drawn else 1)]
    combinations = [dict(zip(lists, values, strict=True)) for values in itertools.product(*lists.values())]
    candidates = [{key: {**c, **draw}[key] for key in space} for c in combinations for draw in draws]
    return [candidate for i, candidate in enumerate(candidates) if candidate not in candidates[:i]]
