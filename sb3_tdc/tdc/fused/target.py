"""The λ-LCB target on buffers that are kept."""

import math

import torch as th

from sb3_tdc.tdc.quantiles import Target


class LcbTarget:
    """
    :func:`~sb3_tdc.tdc.quantiles.lcb_target` of tensors that are kept.

    :param next_quantiles: (C, B, N), contiguous, read by each call
    :param rewards: (B, 1), read by each call
    :param dones: (B, 1), read by each call
    :param discounts: (B, 1), read by each call
    :param lam: scalar, λ, read by each call
    """

    def __init__(
        self, next_quantiles: th.Tensor, rewards: th.Tensor, dones: th.Tensor, discounts: th.Tensor, lam: th.Tensor
    ):
        self.rewards, self.dones, self.discounts, self.lam = rewards, dones, discounts, lam
        n_critics, self.batch_size, n_quantiles = next_quantiles.shape
        self.next_quantiles, self.next_rows = next_quantiles, next_quantiles.view(-1, n_quantiles)
        self.sqrt_n = math.sqrt(n_quantiles)
        self.centred = th.empty_like(next_quantiles)
        self.mean, self.norm, self.bound = (next_quantiles.new_empty(n_critics, self.batch_size, 1) for _ in range(3))
        self.bounds = self.bound.squeeze(2)
        self.row_numbers = th.arange(self.batch_size, device=next_quantiles.device)
        self.selected, self.index = th.empty_like(self.row_numbers), th.empty_like(self.row_numbers)
        self.smallest = self.bounds.new_empty(self.batch_size)
        self.factor = th.empty_like(dones)
        self.taken, self.quantiles = (next_quantiles.new_empty(self.batch_size, n_quantiles) for _ in range(2))

    def compute(self) -> th.Tensor:
        """:return: (B, N), y_j, overwritten by the next call"""
        th.mean(self.next_quantiles, dim=2, keepdim=True, out=self.mean)
        th.sub(self.next_quantiles, self.mean, out=self.centred)
        th.linalg.vector_norm(self.centred, dim=2, keepdim=True, out=self.norm)  # √N·σ (Eq. 4)
        th.addcmul(self.mean, self.lam, self.norm, value=-1 / self.sqrt_n, out=self.bound)
        # Eq. 5. Of equal critics the first, as with argmin, which takes six times as long
        th.min(self.bounds, dim=0, out=(self.smallest, self.selected))
        th.add(self.row_numbers, self.selected, alpha=self.batch_size, out=self.index)
        th.index_select(self.next_rows, 0, self.index, out=self.taken)  # Eq. 6
        th.addcmul(self.discounts, self.discounts, self.dones, value=-1, out=self.factor)
        return th.addcmul(self.rewards, self.factor, self.taken, out=self.quantiles)  # Eq. 7

    def details(self) -> Target:
        """:return: the last target, with what :func:`~sb3_tdc.tdc.quantiles.lcb_target` tells of it"""
        mean, std = self.mean[..., 0].T, self.norm[..., 0].T / self.sqrt_n
        return Target(self.quantiles, mean, std, self.selected)
