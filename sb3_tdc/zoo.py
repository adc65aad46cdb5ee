"""
TDC and MEOW within RL Zoo itself: ``register()``, or ``python -m sb3_tdc.zoo train --algo tdc --env Hopper-v4``.

The only module that imports ``rl_zoo3`` (extra ``[zoo]``).
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from sb3_tdc.hyperparams import hyperparams_file
from sb3_tdc.meow import MEOW
from sb3_tdc.tdc import TDC


def register() -> None:
    """
    Register ``tdc`` and ``meow`` with RL Zoo, for its training, its playing and its Optuna search.

    :raises ImportError: if rl_zoo3 is missing, with the command that installs it
    """
    try:
        from rl_zoo3 import ALGOS, hyperparams_opt
    except ModuleNotFoundError as error:
        if error.name != "rl_zoo3":
            raise
        raise ImportError('RL Zoo is not installed: pip install "sb3-tdc[zoo]"') from error
    ALGOS.update(tdc=TDC, meow=MEOW)
    hyperparams_opt.HYPERPARAMS_SAMPLER.update(tdc=sample_tdc_params, meow=sample_meow_params)
    hyperparams_opt.HYPERPARAMS_CONVERTER.update(tdc=convert_tdc_params, meow=convert_meow_params)


def sample_tdc_params(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample from the search space: RL Zoo's for TD3, λ among the paper's candidates (and 0), and ``n_quantiles``.

    :param trial: an ``optuna.Trial``
    :return: keyword arguments of TDC
    """
    from rl_zoo3.hyperparams_opt import sample_td3_params

    hyperparams = sample_td3_params(trial, n_actions, n_envs, additional_args)
    hyperparams["lam"] = trial.suggest_float("lam", 0.0, 1.0, step=0.1)
    hyperparams["policy_kwargs"]["n_quantiles"] = trial.suggest_categorical("n_quantiles", [16, 25, 64])
    return {"action_noise": None, **hyperparams}  # a trial without noise has none, not TDC's default


def sample_meow_params(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample from the search space: RL Zoo's for TD3 without its noise, α, and the upper limit of log σ.

    :param trial: an ``optuna.Trial``
    :return: keyword arguments of MEOW
    """
    from rl_zoo3.hyperparams_opt import sample_td3_params

    hyperparams = sample_td3_params(trial, n_actions, n_envs, additional_args)
    hyperparams.pop("action_noise", None)
    hyperparams["policy_kwargs"]["log_std_max"] = trial.suggest_float("log_std_max", -0.3, 2.0)
    return {**hyperparams, "ent_coef": trial.suggest_float("ent_coef", 0.01, 1.0, log=True)}


def convert_meow_params(sampled: dict[str, Any]) -> dict[str, Any]:
    """
    Convert the sampled parameters to hyperparameters of MEOW.

    :param sampled: the parameters of a finished Optuna trial
    :return: hyperparameters as in a YAML file
    """
    from rl_zoo3.hyperparams_opt import convert_offpolicy_params

    hyperparams = convert_offpolicy_params(sampled)
    hyperparams["policy_kwargs"]["log_std_max"] = hyperparams.pop("log_std_max")
    return {name: value for name, value in hyperparams.items() if not name.startswith("noise_")}


def convert_tdc_params(sampled: dict[str, Any]) -> dict[str, Any]:
    """
    Convert the sampled parameters to hyperparameters of TDC.

    :param sampled: the parameters of a finished Optuna trial
    :return: hyperparameters as in a YAML file
    """
    from rl_zoo3.hyperparams_opt import convert_offpolicy_params

    hyperparams = convert_offpolicy_params(sampled)
    if hyperparams.get("noise_type") is None:
        hyperparams.pop("noise_type", None)
        hyperparams.pop("noise_std", None)
        hyperparams["action_noise"] = None
    return hyperparams


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run RL Zoo's ``train`` or ``enjoy`` with TDC and MEOW registered.

    ``train`` with ``--algo tdc`` or ``meow``, and without ``-conf``, uses this package's hyperparameters.

    :param argv: arguments; by default, those of the process
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv[:1] not in (["train"], ["enjoy"]):
        sys.exit("usage: python -m sb3_tdc.zoo {train,enjoy} [RL Zoo's arguments]")
    register()
    from rl_zoo3.enjoy import enjoy
    from rl_zoo3.train import train

    command, *arguments = argv
    relevant = argparse.ArgumentParser(add_help=False)
    relevant.add_argument("--algo")
    chosen, _ = relevant.parse_known_args(arguments)
    if command == "train" and chosen.algo in ("tdc", "meow"):
        arguments = ["-conf", str(hyperparams_file(chosen.algo)), *arguments]  # the user's -conf comes later and wins
    sys.argv = [f"sb3_tdc.zoo {command}", *arguments]  # RL Zoo reads its arguments from there
    {"train": train, "enjoy": enjoy}[command]()


if __name__ == "__main__":
    main()
