"""Training scalars that stay on the device until the logger reads them."""

import math
from collections.abc import Mapping

import torch as th
from stable_baselines3.common.logger import Logger

from sb3_tdc.common.finite import ADVICE, NonFiniteError

# Pending scalars are fetched when there are this many, so that a run that never logs still notices a NaN
_MAX_PENDING = 1000


class Diagnostics:
    """
    Running means of scalar tensors by name.

    ``fetch`` waits for the device once. ``add`` waits only when so many scalars are pending that it must fetch them.
    ``is_recorded`` says whether the logger has the means; a caller that adds values sets it to False.
    """

    def __init__(self) -> None:
        self._pending: list[tuple[str, int, int, th.Tensor | float]] = []
        self._sums: dict[str, float] = {}
        self._counts: dict[str, int] = {}
        self._last_finite: dict[str, int] = {}
        self._ended: list[str] = []  # means that restart with their next value
        self.is_recorded = True

    def add(self, update: int, timestep: int, values: Mapping[str, th.Tensor | float]) -> None:
        """
        Add the scalars of one update.

        :param update: count of gradient steps
        :param timestep: count of environment steps
        :param values: scalars by name: tensors (without gradient) on one device, or numbers
        :raises NonFiniteError: if the pending values are fetched, and one is NaN or infinite
        """
        self._pending += [(name, update, timestep, value) for name, value in values.items()]
        if len(self._pending) >= _MAX_PENDING:
            self._collect()

    def fetch(self) -> dict[str, float]:
        """
        Fetch the means from the device.

        :return: the mean of every scalar since the last :meth:`restart`; of a scalar without a value since then, the
            mean from before it
        :raises NonFiniteError: if a scalar is NaN or infinite; the error names the first such update
        """
        self._collect()
        return {name: self._sums[name] / self._counts[name] for name in self._sums}

    def restart(self) -> None:
        """Restart every mean at its next value."""
        self._collect()
        self._ended = list(self._sums)

    def record(self, logger: Logger) -> None:
        """
        Record the means in a logger as ``train/...``.

        :raises NonFiniteError: as :meth:`fetch`
        """
        for name, mean in self.fetch().items():
            logger.record(f"train/{name}", mean)
        self.is_recorded = True

    def _collect(self) -> None:
        if not self._pending:
            return
        pending, self._pending = self._pending, []
        tensors = [value for *_, value in pending if isinstance(value, th.Tensor)]
        fetched = iter(th.stack(tensors).tolist() if tensors else [])  # the only wait for the device
        for name, update, timestep, value in pending:
            number = next(fetched) if isinstance(value, th.Tensor) else value
            if not math.isfinite(number):
                last = self._last_finite.get(name)
                before = f"it was last seen finite at update {last}" if last is not None else "it was never seen finite"
                since = f"since update {update} (timestep {timestep})"
                raise NonFiniteError(f"{name} is {number} {since}; {before}. {ADVICE}")
            self._last_finite[name] = update
            if name in self._ended:
                self._ended.remove(name)
                self._sums[name], self._counts[name] = 0.0, 0
            self._sums[name] = self._sums.get(name, 0.0) + number
            self._counts[name] = self._counts.get(name, 0) + 1
