"""Files of tensors whose pickle contradicts their bytes, and weights and optimizer states that cannot be used."""

import io
import zipfile
from itertools import pairwise

import torch as th
from stable_baselines3 import TD3

from tests.safe_load.attacks.pickles import colliding_in_appended_pairs
from tests.safe_load.attacks.tools import Op, pth, rewrite, tensor, with_fields


def _policy(tree: bytes, **records: bytes):
    """Return a ``make`` that replaces all weights with the tensors of a pickle, ``tree``, over ``records``."""
    named = Op.PROTO + Op.EMPTY_DICT + Op.text("w") + tree + Op.SETITEM + Op.STOP
    return lambda folder, model: rewrite(model, folder / "x.zip", **{"policy.pth": pth(named, **records)})


def changed(name, change):
    """Return a ``make`` that changes the content of one file of tensors, such as the state of an optimizer."""

    def make(folder, model):
        with zipfile.ZipFile(model) as archive:
            state = th.load(io.BytesIO(archive.read(name)), weights_only=True)
        result = change(state)
        state = result if isinstance(result, (dict, list)) else state
        file = io.BytesIO()
        th.save(state, file)
        return rewrite(model, folder / "x.zip", **{name: file.getvalue()})

    return make


def one_storage(folder, model, width=2048, depth=16):
    """A TD3 whose layers are all parts of the same numbers, most of them 0: a file of 0.3 MB, networks of 1.4 GiB."""
    numbers, weights = th.zeros(width**2), {}
    numbers[: width**2 // 64] = th.rand(width**2 // 64)  # all zeros would be compressed more than a hundredfold
    for role in ("", "_target"):
        for network, n_inputs in ((f"actor{role}.mu", 3), (f"critic{role}.qf0", 4), (f"critic{role}.qf1", 4)):
            for i, (n_in, n_out) in enumerate(pairwise([n_inputs, *[width] * depth, 1])):
                weights[f"{network}.{2 * i}.weight"] = numbers[: n_out * n_in].view(n_out, n_in)
                weights[f"{network}.{2 * i}.bias"] = numbers[:n_out]
    file = io.BytesIO()
    th.save(weights, file)
    kwargs = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 100, "device": "cpu"}
    TD3("MlpPolicy", "Pendulum-v1", **kwargs).save(folder / "td3.zip")
    large = with_fields(folder / "td3.zip", folder / "large.zip", policy_kwargs={"net_arch": [width] * depth})
    rewrite(io.BytesIO(file.getvalue()), folder / "policy.pth", deflate=True)
    return rewrite(large, folder / "x.zip", **{"policy.pth": (folder / "policy.pth").read_bytes()})


_NUMBERS = bytes(40)
_GOOD = tensor(10, (10,), (1,))
_SET = Op.name("torch", "Tensor.set_") + Op.tuple_of(_GOOD, _GOOD) + Op.REDUCE
_HUGE_BYTEARRAY = Op.name("builtins", "bytearray") + Op.tuple_of(Op.integer(2**31 - 1)) + Op.REDUCE
ATTACKS = {
    "a hundred thousand dimensions": _policy(tensor(10, (1,) * 100_000, (1,) * 100_000), data_0=_NUMBERS),
    "dimensions whose product overflows": _policy(tensor(10, (2**40, 2**40), (2**40, 1)), data_0=_NUMBERS),
    "a stride of zero": _policy(tensor(1, (8000, 8000), (0, 0)), data_0=bytes(4)),
    "a stride that overlaps": _policy(tensor(10, (8, 8), (1, 0)), data_0=_NUMBERS),
    "negative numbers": _policy(tensor(10, (-1,), (1,)), data_0=_NUMBERS),
    "a storage beyond its record": _policy(tensor(1000, (1000,), (1,)), data_0=_NUMBERS),
    "a storage without a record": _policy(tensor(10, (10,), (1,))),
    "a storage of two types": _policy(
        _GOOD + Op.SETITEM + Op.text("v") + tensor(5, (5,), (1,), kind="DoubleStorage"), data_0=_NUMBERS
    ),
    "BUILD on a tensor": _policy(_GOOD + Op.tuple_of(_SET) + Op.BUILD, data_0=_NUMBERS),
    "BUILD on a tensor with a mapping": _policy(
        _GOOD + Op.EMPTY_DICT + Op.text("data") + _GOOD + Op.SETITEM + Op.BUILD, data_0=_NUMBERS
    ),
    "a call instead of a tensor": _policy(_SET, data_0=_NUMBERS),
    "a bytearray of 2 GiB": _policy(_HUGE_BYTEARRAY, data_0=_NUMBERS),
    "a bytearray of 2 GiB in an argument": _policy(tensor(10, (10,), (1,), more=_HUGE_BYTEARRAY), data_0=_NUMBERS),
    "two arguments too many": _policy(tensor(10, (10,), (1,), more=Op.NONE + Op.NONE), data_0=_NUMBERS),
    "items appended to a tensor": _policy(_GOOD + Op.NONE + Op.APPEND, data_0=_NUMBERS),
    "colliding names of weights": lambda folder, model: rewrite(
        model, folder / "x.zip", **{"policy.pth": pth(colliding_in_appended_pairs())}
    ),
    "no exp_avg": changed("actor.optimizer.pth", lambda s: s["state"][0].pop("exp_avg")),
    "betas of text": changed("actor.optimizer.pth", lambda s: s["param_groups"][0].update(betas=("a", "b"))),
    "a step that is NaN": changed("actor.optimizer.pth", lambda s: s["state"][0].update(step=th.tensor(th.nan))),
    "a state of parameter -1": changed("actor.optimizer.pth", lambda s: s["state"].update({-1: s["state"][0]})),
    "moments that are infinite": changed(
        "critic.optimizer.pth", lambda s: s["state"][0].update(exp_avg=s["state"][0]["exp_avg"] + th.inf)
    ),
    "no temperature": lambda folder, model: rewrite(model, folder / "x.zip", **{"pytorch_variables.pth": None}),
    "a temperature that is None": changed("pytorch_variables.pth", lambda s: dict.fromkeys(s)),
    "layers of one storage": one_storage,
    "weights that are a list": changed("policy.pth", lambda s: list(s.values())),
    "weights of another type": changed("policy.pth", lambda s: {name: value.half() for name, value in s.items()}),
    "numbers in the order of another processor": _policy(_GOOD, data_0=_NUMBERS, byteorder=b"big"),
}
