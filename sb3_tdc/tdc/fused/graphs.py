"""CUDA graphs of functions of static tensors: each is launched at once, without Python in between."""

from collections.abc import Callable
from typing import Any

import torch as th

_WARM_UP_CALLS = 3  # libraries choose kernels and allocate workspaces in the first calls, which cannot be captured


class CudaGraphs:
    """
    A caller that runs a function directly a few times, then captures it as a graph, and replays it from then on.

    A function must read and write the same tensors each time, must not branch on their values, and must not wait for
    the device. The next call overwrites its result. Python numbers that it reads keep their values from the capture.
    """

    def __init__(self) -> None:
        self._calls: dict[str, int] = {}
        self._graphs: dict[str, tuple[th.cuda.CUDAGraph, Any]] = {}

    def __call__(self, function: Callable[[], Any]) -> Any:
        name = function.__name__
        if name not in self._graphs:
            self._calls[name] = self._calls.get(name, 0) + 1
            if self._calls[name] <= _WARM_UP_CALLS:
                return self._call_on_side_stream(function)
            self._graphs[name] = self._capture(function)
        graph, result = self._graphs[name]
        graph.replay()
        return result

    @staticmethod
    def _call_on_side_stream(function: Callable[[], Any]) -> Any:
        side = th.cuda.Stream()
        side.wait_stream(th.cuda.current_stream())
        with th.cuda.stream(side):
            result = function()
        th.cuda.current_stream().wait_stream(side)
        return result

    @staticmethod
    def _capture(function: Callable[[], Any]) -> tuple[th.cuda.CUDAGraph, Any]:
        graph = th.cuda.CUDAGraph()
        with th.cuda.graph(graph):
            result = function()
        return graph, result
