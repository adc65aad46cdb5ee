"""The fused update as a CUDA graph runs it: no Python between the operations, numbers as they were captured."""

import numpy as np
import pytest
import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sb3_tdc.tdc.fused.graphs import CudaGraphs
from tests.helpers.tdc import HEADS, BatchQueue, TwoActions, assert_close, make, make_model, random_batches, states

pytestmark = pytest.mark.usefixtures("torch_loops")  # as on a GPU
WAITS = {th.ops.aten._local_scalar_dense.default, th.ops.aten.nonzero.default, th.ops.aten.equal.default}


class Recording(TorchDispatchMode):
    """The operations of one call, with the tensors they were called on; they can be run again without the caller."""

    def __init__(self):
        super().__init__()
        self.operations = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        assert function not in WAITS, f"{function} waits for the device"
        result = function(*args, **(kwargs or {}))
        self.operations.append((function, args, kwargs or {}, result))
        return result

    def replay(self):
        for function, args, kwargs, recorded in self.operations:
            storages = {t.untyped_storage().data_ptr() for t in tree_leaves((args, kwargs)) if isinstance(t, th.Tensor)}
            fresh = function(*args, **kwargs)
            for old, new in zip(tree_leaves(recorded), tree_leaves(fresh), strict=True):
                if isinstance(old, th.Tensor) and old.untyped_storage().data_ptr() not in storages:
                    old.copy_(new)


class RecordedGraphs:
    """Stands in for ``CudaGraphs``."""

    def __init__(self):
        self.recordings = {}

    def __call__(self, function):
        name = function.__name__
        if name in self.recordings:
            recording, result = self.recordings[name]
            recording.replay()
            return result
        with Recording() as recording:
            result = function()
        self.recordings[name] = recording, result
        return result


@HEADS
def test_what_is_replayed_is_what_would_be_computed(stochastic_actor):
    """With schedules of λ and of both learning rates, which change between the replays."""

    def falling(progress):
        return 1e-3 * progress

    kwargs = {
        "lam": lambda progress: 2 * progress,
        "learning_rate": falling,
        "qf_learning_rate": lambda progress: 2e-3 * progress,
        "stochastic_actor": stochastic_actor,
    }
    finals = []
    for graphs in (None, RecordedGraphs()):
        model = make_model(fused=True, **kwargs)
        model.replay_buffer = BatchQueue(random_batches(60, batch=16))
        th.manual_seed(1)
        for step in range(60):
            model._current_progress_remaining = 1 - step / 60
            if graphs is not None and model._fused_update is not None:
                model._fused_update.run = graphs
            model.train(gradient_steps=1, batch_size=16)
        logged = model._diagnostics.fetch()
        finals.append(states(model) | {f"logged.{k}": th.tensor(v, dtype=th.float64) for k, v in logged.items()})
    assert len(graphs.recordings) == 3
    assert_close(*finals, rtol=1e-6, atol=1e-7)


def test_numbers_of_python_are_those_of_the_capture():
    """Otherwise the test above would prove nothing."""
    graphs, numbers, total = RecordedGraphs(), iter([1.0, 2.0]), th.zeros(())

    def add():
        total.add_(next(numbers))

    graphs(add)
    graphs(add)
    assert total.item() == 2.0
    with pytest.raises(AssertionError, match="waits for the device"):
        graphs(lambda: total.item())


def test_a_change_of_what_is_captured_makes_new_graphs():
    model = make(fused=True).learn(60)
    for name, value in {"kappa": 2.0, "tau": 0.1, "target_policy_noise": 0.0, "target_noise_clip": 0.1}.items():
        bound = model._fused_update
        setattr(model, name, value)
        model.train(gradient_steps=1, batch_size=16)
        assert model._fused_update is not bound, name
    bound = model._fused_update
    model.train(gradient_steps=1, batch_size=16)
    assert model._fused_update is bound


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@HEADS
def test_on_a_gpu(stochastic_actor):
    """CUDA graphs against the same operations without graphs, with the same seeds after the same training."""
    model = make(TwoActions(), fused=True, device="cuda", stochastic_actor=stochastic_actor).learn(300)
    assert isinstance(model._fused_update.run, CudaGraphs)
    assert model._fused_update.packed_replay is not None
    assert len(model._fused_update.run._graphs) == 3
    assert all(weight.isfinite().all() for weight in model.policy.state_dict().values())
    eager = make(TwoActions(), fused=True, device="cuda", stochastic_actor=stochastic_actor).learn(60)
    eager._fused_update.run = lambda function: function()
    graphed = make(TwoActions(), fused=True, device="cuda", stochastic_actor=stochastic_actor).learn(60)
    for each in (eager, graphed):
        np.random.seed(0)
        th.manual_seed(0)
        each.train(gradient_steps=50, batch_size=16)
    assert_close(states(eager), states(graphed), rtol=1e-3, atol=1e-4)
