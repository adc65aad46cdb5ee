"""Evaluations during training that also compare TDC's critics with realised returns, as :mod:`sb3_tdc.critics` does."""

import time
from typing import Any

from stable_baselines3.common.logger import Image, TensorBoardOutputFormat

from sb3_tdc.critics.episodes import EVERY, Episode, Recording, summarise
from sb3_tdc.critics.figures import make_figure, render
from sb3_tdc.runs.callbacks.stopping import StoppableEvaluation
from sb3_tdc.tdc import TDC

# A figure is drawn only if the recordings and the figure take less than this share of the time since training began
_SHARE = 0.01
_SECONDS_OF_FIRST_FIGURE = 2.0


class CriticEvaluationCallback(StoppableEvaluation):
    """
    An evaluation that also compares TDC's critics with the returns of its episodes; a plain one for other algorithms.

    Logs the results of :func:`~sb3_tdc.critics.episodes.summarise` as ``eval/...`` and the seconds that the comparison
    has taken since training began as ``time/critics_elapsed``. Also writes a figure to TensorBoard, ``eval/critics``,
    as often as fits in one percent of the time. Plays no additional steps, and draws no random numbers. Logs nothing
    before the first update, nor where a time limit ends episodes before the discount has faded.
    """

    def _init_callback(self) -> None:
        super()._init_callback()
        self.recordings: dict[int, Recording] = {}
        self.episodes: list[Episode] = []
        self.elapsed = 0.0
        self.seconds_per_figure = _SECONDS_OF_FIRST_FIGURE
        spec = self.eval_env.get_attr("spec")[0]
        self.time_limit = spec.max_episode_steps if spec is not None else None

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        super()._log_success_callback(locals_, globals_)
        if isinstance(self.model, TDC) and self.model._n_updates > 0:
            start = time.perf_counter()
            self._record(self.model, locals_)
            self.elapsed += time.perf_counter() - start
            self.logger.record("time/critics_elapsed", self.elapsed, exclude="tensorboard")

    def _record(self, model: TDC, step: dict[str, Any]) -> None:
        """
        Record a step of an evaluation.

        :param step: the local variables of ``evaluate_policy``
        """
        i, observations = step["i"], step["observations"]
        if i not in self.recordings:
            self.recordings[i] = Recording(model, EVERY, model.get_vec_normalize_env(), self.time_limit)
        observation = {k: v[i] for k, v in observations.items()} if isinstance(observations, dict) else observations[i]
        self.recordings[i].add(observation, step["actions"][i], float(step["reward"]))
        if not step["done"]:
            return
        self.episodes.append(self.recordings.pop(i).finish(not step["info"].get("TimeLimit.truncated", False)))
        if len(self.episodes) == self.n_eval_episodes:
            episodes, self.episodes = self.episodes, []
            summary = summarise(episodes)
            for name, value in summary.items():
                self.logger.record(f"eval/{name}", value)
            if summary:
                self._draw(episodes)

    def _draw(self, episodes: list[Episode]) -> None:
        start = time.perf_counter()
        seconds = (time.time_ns() - self.model.start_time) / 1e9
        has_tensorboard = any(isinstance(writer, TensorBoardOutputFormat) for writer in self.logger.output_formats)
        if not has_tensorboard or self.elapsed + self.seconds_per_figure > _SHARE * seconds:
            return
        title = f"Evaluation at step {self.num_timesteps:,}"
        try:
            picture = render(make_figure(episodes, title, self.model.scheduled("lam")))  # type: ignore[attr-defined]
        except ImportError:  # without matplotlib, the logged numbers must do
            return
        self.logger.record("eval/critics", Image(picture, "HWC"), exclude=("stdout", "log", "json", "csv"))
        self.seconds_per_figure = time.perf_counter() - start
