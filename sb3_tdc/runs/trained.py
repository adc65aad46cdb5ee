"""Open a finished run: its model with the environment that it was trained in."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.common.untrusted import escaped
from sb3_tdc.envs.checked import EnvironmentFaultError
from sb3_tdc.envs.make import SETUP_ERRORS, make_envs
from sb3_tdc.envs.registry import has_vector_env, import_packages, require_env, split_env_id
from sb3_tdc.hyperparams import Hyperparams, parse
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.models import load_model, needs_trust
from sb3_tdc.safe_load.run_files import check_arguments, check_imports, refused_imports

# What of a run's hyperparameters the environments are made of
_OF_THE_ENVIRONMENT = ("normalize", "frame_stack", "env_wrapper", "vec_env_wrapper", "env_kwargs")


@dataclass
class TrainedModel:
    """
    A saved model, and what it was trained with.

    :param path: the zip
    :param env_id: registered
    :param hyperparams: those that environments are made of
    :param env_kwargs: of training
    :param eval_env_kwargs: of evaluations, where these differ
    :param normalization: saved statistics of ``VecNormalize``, if it was trained with them
    :param trust: whether its files may run code
    :param vec_env: "gymnasium" if it was trained in the vector environment that is registered for the id, else "dummy"
    """

    path: Path
    algo: str
    env_id: str
    hyperparams: Hyperparams
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    eval_env_kwargs: dict[str, Any] = field(default_factory=dict)
    normalization: Path | None = None
    trust: bool = False
    vec_env: str = "dummy"

    def make_env(self, seed: int, **env_kwargs: Any) -> VecEnv:
        """
        Make one environment as in training, with statistics that stay as they are and the rewards of the environment.

        :param env_kwargs: over those of the run
        :raises ValueError: with what the environment or a wrapper raises
        """
        try:
            return make_envs(
                self.env_id,
                self.hyperparams,
                seed,
                n_envs=1,
                env_kwargs=env_kwargs,
                vec_env=self.vec_env,
                normalization=self.normalization,
                training=False,
                trust=self.trust,
            )
        except EnvironmentFaultError as error:
            raise ValueError(str(error)) from error
        except SETUP_ERRORS as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{self.env_id} cannot be made: {reason}") from error

    def load(self, env: VecEnv | None, device: str) -> OffPolicyAlgorithm:
        """
        Load the model, with the smallest replay buffer there is.

        :raises ValueError: if it is refused, or is of another algorithm
        """
        return load_model(self.path, self.algo, env, self.trust, device=device, buffer_size=1)


def find_model(
    run: RunFolder, best: bool = False, checkpoint: int | None = None, last_checkpoint: bool = False
) -> Path:
    """
    Find one of a run's models: the last one by default.

    :param best: the best one instead
    :param checkpoint: the one that was saved at this step instead
    :param last_checkpoint: the last one that was saved during training instead
    :return: the zip
    :raises ValueError: if there is none, with what there is
    """
    checkpoints = run.checkpoints()
    if best:
        path = run.best_model
    elif checkpoint is not None or last_checkpoint:
        steps = checkpoint if checkpoint is not None else max(checkpoints, default=-1)
        if steps not in checkpoints:
            known = f"there are those of steps {', '.join(map(str, checkpoints))}" if checkpoints else "it has none"
            raise ValueError(
                f"{run.path} has no saved model of step {steps}; {known} (sb3-tdc train --save-freq makes them)"
            )
        path = checkpoints[steps]
    else:
        path = run.model
    if not path.is_file():
        others = [p.name for p in (run.model, run.best_model, *checkpoints.values()) if p.is_file()]
        raise ValueError(f"{path} does not exist; in its folder are: {', '.join(others) or 'no models'}")
    return path


def open_run(run: RunFolder, path: Path, consented: Sequence[str] = (), trust: bool = False) -> TrainedModel:
    """
    Read what a model of a run was trained with, import the packages of its environment, and check it.

    :param path: a zip of the run
    :param consented: packages and modules that the user has named, and whose code may therefore be imported
    :param trust: whether the files may name any code
    :raises ValueError: if a file is missing, damaged, or names code that is not allowed
    """
    trained, config = run.args, run.config
    check_arguments(trained, KNOWN_ALGORITHMS, str(run.path / run.env_name / "args.yml"))
    if not trust:
        check_imports(trained, config, consented, str(run.path))
    env_id, packages = split_env_id(trained["env"], [*trained["gym_packages"], *consented])
    import_packages(packages)
    require_env(env_id)
    of_the_environment = {key: value for key, value in config.items() if key in _OF_THE_ENVIRONMENT}
    gamma = {"gamma": config["gamma"]} if "gamma" in config else {}
    where = str(run.path / run.env_name / "config.yml")
    hyperparams = parse({"n_timesteps": 1, **gamma, **of_the_environment}, KNOWN_ALGORITHMS[trained["algo"]], where)
    return TrainedModel(
        path,
        trained["algo"],
        env_id,
        hyperparams,
        trained["env_kwargs"] or {},
        trained.get("eval_env_kwargs") or {},
        run.find_normalization(path) if hyperparams.normalize is not None else None,
        trust,
        vec_env="gymnasium" if trained.get("vec_env") == "gymnasium" and has_vector_env(env_id) else "dummy",
    )


def flags_to_open(runs: Iterable[RunFolder]) -> list[str]:
    """Return the flags with which ``enjoy`` and ``evaluate`` open runs: the consent to the user's own code in them."""
    runs = list(runs)
    modules = dict.fromkeys(escaped(module) for run in runs for module, _ in refused_imports(run.args, run.config))
    trust = any(needs_trust(run.model, run.args["algo"]) for run in runs if run.model.is_file())
    return [*(["--gym-packages", *modules] if modules else []), *(["--trust"] if trust else [])]


def open_zip(path: Path, algo: str, env_id: str, trust: bool = False) -> TrainedModel:
    """Return a model that lies outside a run, with the algorithm and the registered environment that the user names."""
    require_env(env_id)
    return TrainedModel(path, algo, env_id, parse({"n_timesteps": 1}, KNOWN_ALGORITHMS[algo], str(path)), trust=trust)
