"""Checks of the YAML files of a downloaded run: its arguments have the right types, and its wrappers only wrap."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from sb3_tdc.common.untrusted import escaped, shown

# Classes that write no file and start no process, by the package or module that contains them
_WRAPPERS: dict[str, set[str]] = {
    "gymnasium.wrappers": {
        *("AddRenderObservation", "AddWhiteNoise", "AtariPreprocessing", "Autoreset", "ClipAction", "ClipReward"),
        *("DelayObservation", "DiscretizeAction", "DiscretizeObservation", "DtypeObservation", "FilterObservation"),
        *("FlattenObservation", "FrameStackObservation", "GrayscaleObservation", "HumanRendering", "OrderEnforcing"),
        *("MaxAndSkipObservation", "NormalizeObservation", "NormalizeReward", "ObstructView", "PassiveEnvChecker"),
        *("RecordEpisodeStatistics", "RenderCollection", "RepeatAction", "RescaleAction", "RescaleObservation"),
        *("ReshapeObservation", "ResizeObservation", "StickyAction", "TimeAwareObservation", "TimeLimit"),
    },
    "stable_baselines3.common.vec_env": {
        *("VecCheckNan", "VecExtractDictObs", "VecFrameStack", "VecMonitor", "VecNormalize", "VecTransposeImage"),
    },
    "stable_baselines3.common.monitor": {"Monitor"},
    "stable_baselines3.common.atari_wrappers": {
        *("AtariWrapper", "ClipRewardEnv", "EpisodicLifeEnv", "FireResetEnv", "MaxAndSkipEnv", "NoopResetEnv"),
        *("StickyActionEnv", "WarpFrame"),
    },
    "sb3_contrib.common.wrappers": {"TimeFeatureWrapper"},
    "rl_zoo3.wrappers": {
        *("ActionNoiseWrapper", "ActionSmoothingWrapper", "DelayedRewardWrapper", "FrameSkip", "HistoryWrapper"),
        *("HistoryWrapperObsDict", "MaskVelocityWrapper", "TimeFeatureWrapper", "TruncatedOnSuccessWrapper"),
        *("YAMLCompatResizeObservation", "ResizeObservation"),
    },
}
_NAMES_A_FILE = re.compile("file|path|folder|dir", re.IGNORECASE)
_ARGUMENTS: dict[str, tuple[type, ...]] = {
    "algo": (str,),
    "env": (str,),
    "gym_packages": (list,),
    "env_kwargs": (dict, type(None)),
}


def check_arguments(args: Mapping[str, Any], algorithms: Collection[str], where: str) -> None:
    """
    Check the types of a run's arguments.

    :param args: content of ``args.yml``
    :param algorithms: names of the known algorithms
    :param where: path of the file, for the error
    :raises ValueError: if a required argument is missing or of another type, or the algorithm is unknown
    """
    for name, kinds in _ARGUMENTS.items():
        if name not in args or not isinstance(args[name], kinds):
            found = shown(args[name]) if name in args else "nothing"
            kind = "a text" if str in kinds else "a list" if list in kinds else "a mapping"
            raise ValueError(f"{where}: {name} must be {kind}, got {found}")
    if not all(isinstance(package, str) for package in args["gym_packages"]):
        raise ValueError(f"{where}: gym_packages must be names")
    if args["algo"] not in algorithms:
        raise ValueError(f"{where}: algo must be one of {', '.join(algorithms)}, got {shown(args['algo'])}")


def check_imports(args: Mapping[str, Any], config: Mapping[str, Any], consented: Sequence[str], where: str) -> None:
    """
    Check that the files of a run only name code that is known, or that the user has consented to.

    :param args: content of ``args.yml``
    :param config: content of ``config.yml``
    :param consented: packages and modules that the user has named
    :param where: the run, for the error
    :raises ValueError: if the files name code to import that is neither known to be harmless nor consented to
    """
    for _, reason in refused_imports(args, config, consented):
        raise ValueError(f"{where} asks for {reason}")


def refused_imports(
    args: Mapping[str, Any], config: Mapping[str, Any], consented: Sequence[str] = ()
) -> Iterator[tuple[str, str]]:
    """Yield the module of each import that :func:`check_imports` refuses, with a description and the remedy."""
    package, _, _ = args["env"].rpartition(":")
    for name in [*(args.get("gym_packages") or []), *([package] if package else [])]:
        if name not in consented:
            yield name, f"the package {escaped(name)}: if you know it, add --gym-packages {escaped(name)}"
    for key, name, kwargs in _wrappers(config):
        if any(name.startswith(f"{prefix}.") for prefix in consented):
            continue
        module, _, _ = name.rpartition(".")
        wrapper, remedy = f"{key} {escaped(name)}", "if you know it, add its module to --gym-packages"
        if not _is_known(name):
            yield module, f"{wrapper}: {remedy}"
        for argument in kwargs or {} if isinstance(kwargs, dict | None) else [kwargs]:
            if not isinstance(argument, str) or _NAMES_A_FILE.search(argument):
                yield module, f"{wrapper} with {shown(argument)}, which may write a file: {remedy}"


def _wrappers(config: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Yield the key, the name and the keyword arguments of each wrapper."""
    for key in ("env_wrapper", "vec_env_wrapper"):
        wrappers = config.get(key) or []
        for wrapper in wrappers if isinstance(wrappers, list) else [wrappers]:
            for name, kwargs in wrapper.items() if isinstance(wrapper, dict) else [(wrapper, None)]:
                yield key, str(name), kwargs


def _is_known(name: str) -> bool:
    module, _, cls = name.rpartition(".")
    roots = [root for root in _WRAPPERS if module == root or module.startswith(f"{root}.")]
    return any(cls in _WRAPPERS[root] for root in roots)
