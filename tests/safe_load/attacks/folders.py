"""Run folders whose YAML is a bomb, a pipe or a device, lacks required keys, or names wrappers that write files."""

import os
import shutil

from sb3_tdc.runs.folder import RunFolder

ARGS = {"algo": "tdc", "env": "Pendulum-v1", "gym_packages": [], "env_kwargs": {}, "seed": 1}


def run(folder, model, args=ARGS, config=None):
    made = RunFolder.create(folder, "tdc", "Pendulum-v1")
    made.write_config({"n_timesteps": 10, **(config or {})}, args)
    shutil.copy(model, made.model)
    return made


def _with_text(name, text):
    def make(folder, model):
        made = run(folder, model)
        (made.path / made.env_name / name).write_text(text)
        return made.path

    return make


def _replaced(name, replace):
    def make(folder, model):
        made = run(folder, model)
        path = made.path / made.env_name / name
        path.unlink()
        replace(path)
        return made.path

    return make


LAUGHS = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
MERGES = "m0: &m0 {a: 1}\n" + "".join(f"m{i}: &m{i} {{<<: [{', '.join([f'*m{i - 1}'] * 9)}]}}\n" for i in range(1, 9))
WRAPPERS = {
    "a Monitor with a file": {"stable_baselines3.common.monitor.Monitor": {"filename": "owned"}},
    "a VecMonitor with a file": {"stable_baselines3.common.vec_env.VecMonitor": {"filename": "owned"}},
    "a video": {"gymnasium.wrappers.RecordVideo": {"video_folder": "owned"}},
    "a re-exported writer": {"stable_baselines3.common.logger.SummaryWriter": {"log_dir": "owned"}},
    "a function": "stable_baselines3.common.monitor.load_results",
    "a module's module": "gymnasium.wrappers.os.system",
}
ATTACKS = {
    **{
        f"{what} in {name}": make(name)
        for name in ("config.yml", "args.yml")
        for what, make in {
            "billion laughs": lambda name: _with_text(name, LAUGHS),
            "merges": lambda name: _with_text(name, MERGES),
            "ten megabytes": lambda name: _with_text(name, "a: [" + "0," * 5_000_000 + "0]"),
            "deep brackets": lambda name: _with_text(name, "[" * 100_000),
            "a pipe": lambda name: _replaced(name, os.mkfifo),
            "a device": lambda name: _replaced(name, lambda path: path.symlink_to("/dev/zero")),
            "a folder": lambda name: _replaced(name, os.mkdir),
            "a list": lambda name: _with_text(name, "[1, 2]"),
        }.items()
    },
    **{
        f"args.yml without {key}": lambda folder, model, key=key: (
            run(folder, model, {name: value for name, value in ARGS.items() if name != key}).path
        )
        for key in ("algo", "env", "gym_packages", "env_kwargs")
    },
    **{
        f"args.yml with {key} {value}": lambda folder, model, key=key, value=value: (
            run(folder, model, {**ARGS, key: value}).path
        )
        for key, value in (
            *(("algo", 3), ("algo", "ppo"), ("env", 3), ("env", None), ("gym_packages", "os"), ("gym_packages", [3])),
            *(("env_kwargs", "x"), ("env", "\x1b[2J")),
        )
    },
    **{
        f"{what} as {kind}": lambda folder, model, kind=kind, wrapper=wrapper: (
            run(folder, model, config={kind: wrapper}).path
        )
        for kind in ("env_wrapper", "vec_env_wrapper")
        for what, wrapper in WRAPPERS.items()
    },
    "wrappers that are a number": lambda folder, model: run(folder, model, config={"env_wrapper": 3}).path,
    "a model that is a pipe": lambda folder, model: _pipe(run(folder, model).model),
    "a model that is a device": lambda folder, model: _device(folder),
}


def _pipe(path):
    path.unlink()
    os.mkfifo(path)
    return path


def _device(folder):
    (folder / "x.zip").symlink_to("/dev/zero")
    return folder / "x.zip"
