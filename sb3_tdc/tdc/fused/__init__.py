"""
The update of ``tdc.py`` on preallocated buffers, for plain ReLU networks: no autograd, no allocation.

What is computed is ``TDC.update_critics``, ``TDC.update_actor`` and ``TDC.update_targets`` to float32 rounding, on the
same random numbers; the backward passes are derived by hand. Parameters, targets and optimizer state keep their
storage. If anything has changed since the update was bound (``snapshot.py``), the model is re-examined
(``applicability.py``), and the readable update takes over where it must (``algorithm.py``).

One transition is one row of a packed replay buffer and of the minibatch. Who reads which columns::

    s | a | s' | r | d | t
    └─┬─┘   │    └───┬───┘
      │     │        target: r, and d − t (the end of an episode that is not that of its time limit)
      │     copied next to ã into [s' | ã]: target actor (s'), target critics (both)
      online critics (both); actor (s), which then writes its actions over a
"""

from sb3_tdc.tdc.fused.algorithm import FusedUpdateAlgorithm
from sb3_tdc.tdc.fused.update import FusedUpdate

__all__ = ["FusedUpdate", "FusedUpdateAlgorithm"]
