"""Values of ``data`` that are absurd, missing, or of another type."""

import numpy as np

from sb3_tdc.algorithms import ALGORITHMS
from tests.safe_load.attacks.tools import fields_of, rewrite, with_fields

REQUIRED = (
    *("gamma", "lam", "tau", "kappa", "learning_rate", "qf_learning_rate", "batch_size", "buffer_size", "train_freq"),
    *("learning_starts", "gradient_steps", "num_timesteps", "policy_delay", "target_policy_noise", "ent_coef"),
    *("target_noise_clip", "stochastic_actor", "action_noise", "policy_class", "_n_updates"),
)
VALUES = {
    "gamma": (1e300, -0.1, 1.01, "0.99", None, True, [0.99]),
    "tau": (-7, 0, 1.5, "x"),
    "kappa": (-1, 10**400),
    "target_policy_noise": (-1, "x"),
    "batch_size": (0, 2.5, 2**80, True),
    "train_freq": (0, [1, "hour"], [1], "x"),
    "num_timesteps": (-1, 1e9, None),
    "n_envs": (0, 10**9),
    "buffer_size": (10**15,),
    "stochastic_actor": (None, 1),
    "seed": (-1, "x"),
}


def layers(algorithm, **policy_kwargs):
    """A model of another algorithm, whose networks have very many small layers."""

    def make(folder, model):
        made = ALGORITHMS[algorithm]("MlpPolicy", "Pendulum-v1", buffer_size=100, device="cpu")
        made.save(folder / "model.zip")
        return with_fields(
            folder / "model.zip", folder / "x.zip", policy_kwargs={"net_arch": [1] * 64, **policy_kwargs}
        )

    return make


def _with(name, value):
    return lambda folder, model: with_fields(model, folder / "x.zip", **{name: value})


ATTACKS = {
    **{f"without {name}": _with(name, ...) for name in REQUIRED},
    **{f"{name} {str(v)[:20]}": _with(name, v) for name, values in VALUES.items() for v in values},
    "a text that drives the terminal": _with("gamma", "\x1b[2J\x1b]0;owned\x07" * 10**6),
    "a field that drives the terminal": _with("\x1b[2J\r", 1),
    "a hundred million brackets": lambda folder, model: rewrite(model, folder / "x.zip", data="[" * 10**8),
    "two million values": lambda folder, model: rewrite(
        model, folder / "x.zip", data='{"a": [' + "0," * 2_000_000 + "0]}"
    ),
    "a number of ten million digits": lambda folder, model: rewrite(
        model, folder / "x.zip", data='{"gamma": ' + "9" * 10**7 + "}"
    ),
    "an enormous network": lambda folder, model: with_fields(
        model, folder / "x.zip", policy_kwargs={**_policy_kwargs(model), "net_arch": [10**6] * 60}
    ),
    "networks of sixteen thousand layers": layers("td3", n_critics=256),
    "a flow of as many": layers("meow", n_blocks=256),
    "nan": lambda folder, model: with_fields(model, folder / "x.zip", tau=np.nan),
}


def _policy_kwargs(model):
    kwargs = fields_of(model)["policy_kwargs"]
    return {name: value for name, value in kwargs.items() if not name.startswith(":")}
