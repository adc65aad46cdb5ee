"""Variants of TDC against float64 transcriptions of their definitions."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_tdc.ablations import ABLATIONS, PessimisticTDC, ScaledKappaTDC, ShiftedTDC
from sb3_tdc.ablations.calibration import CalibratedTDC
from sb3_tdc.cli import enjoy, train
from sb3_tdc.hyperparams import hyperparams_file
from sb3_tdc.runs.models import load_model
from tests.helpers.tdc import BATCH, SMALL, random_batches


def make(kind, **kwargs):
    defaults = {"learning_starts": 5, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    return kind("MlpPolicy", "Pendulum-v1", policy_kwargs=SMALL, **{**defaults, **kwargs})


def random_batch():
    ((*transitions, dones, rewards),) = random_batches(1)
    dones[::2] = 1
    return ReplayBufferSamples(*transitions, dones, rewards)


def targets(model, lam):
    batch = random_batch()
    quantiles = 5 * th.randn((BATCH, 2, 7), generator=th.Generator().manual_seed(0))
    return batch, quantiles.double().numpy(), model.make_target(quantiles, batch, lam).quantiles.numpy()


def moments(quantiles, lam):
    mean, std = quantiles.mean(axis=2), quantiles.std(axis=2)
    rows, selected = np.arange(len(mean)), (mean - lam * std).argmin(axis=1)
    return mean, std[rows, selected], quantiles[rows, selected]


def test_the_shifted_target_is_lower_by_lam_standard_deviations():
    batch, quantiles, found = targets(make(ShiftedTDC, gamma=0.9), lam=0.7)
    _, std, chosen = moments(quantiles, 0.7)
    rewards, dones = batch.rewards.numpy(), batch.dones.numpy()
    expected = rewards + 0.9 * (1 - dones) * (chosen - 0.7 * std[:, None])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("calibrated", "lam", "beta"), [(0.5, 0.5, 0.0), (-0.8, 0.0, 0.8), (0.0, 0.0, 0.0)])
def test_below_zero_the_calibrated_number_is_pessimism(calibrated, lam, beta):
    model = make(PessimisticTDC, gamma=0.9)
    model._calibrated, model._calibrated_from = calibrated, 1.0
    assert (model.scheduled("lam"), model.pessimism) == (lam, beta)
    batch, quantiles, found = targets(model, lam)
    mean, _, chosen = moments(quantiles, lam)
    chosen = chosen - beta * (mean.max(axis=1) - mean.min(axis=1))[:, None]
    expected = batch.rewards.numpy() + 0.9 * (1 - batch.dones.numpy()) * chosen
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_n_step_returns_are_lowered_by_their_own_discounts():
    model, batch = make(ShiftedTDC, gamma=0.9), random_batch()
    batch = batch._replace(discounts=th.full((BATCH, 1), 0.5))
    quantiles = 5 * th.randn((BATCH, 2, 7), generator=th.Generator().manual_seed(0))
    _, std, chosen = moments(quantiles.double().numpy(), 0.7)
    expected = batch.rewards.numpy() + 0.5 * (1 - batch.dones.numpy()) * (chosen - 0.7 * std[:, None])
    np.testing.assert_allclose(
        model.make_target(quantiles, batch, 0.7).quantiles.numpy(), expected, rtol=1e-4, atol=1e-4
    )


def test_overestimation_goes_on_into_pessimism_and_back():
    model = make(PessimisticTDC, lam=0.0)
    model.learn(10)
    for error, expected in ((-1.0, -0.1), (-1.0, -0.2), (1.0, -0.1), (1.0, 0.0), (1.0, 0.1)):
        model._calibrate(np.array([error]))
        assert model.calibrated == pytest.approx(expected)


def test_kappa_follows_the_errors_that_it_bounds():
    model = make(ScaledKappaTDC)
    model.learn(6)
    before = model.kappa
    current, batch = th.zeros((BATCH, 2, 7)), random_batch()
    target = model.make_target(th.full((BATCH, 2, 7), 30.0), batch, 1.0)
    model.diagnose_critics(current, target)
    error = np.abs(target.quantiles.numpy()).mean()  # the critics say 0
    assert model.kappa == pytest.approx(before + 0.05 * (error - before), rel=1e-5)
    assert model.logger is not None


@pytest.mark.parametrize("name", ABLATIONS)
def test_saved_and_opened(name, tmp_path):
    model = make(ABLATIONS[name], lam=0.0).learn(60)
    if isinstance(model, CalibratedTDC):
        model._calibrate(np.array([-1.0 if name == "tdc-pessimism" else 1.0]))
        assert abs(model.calibrated) == pytest.approx(0.1)
    model.save(tmp_path / "model.zip")
    opened = load_model(tmp_path / "model.zip", name, None, False, device="cpu")
    assert type(opened) is ABLATIONS[name]
    assert opened.kappa == model.kappa
    for attribute in ("calibrated", "error_scale"):
        assert getattr(opened, attribute, None) == getattr(model, attribute, None)
    assert hyperparams_file(name) == hyperparams_file("tdc")


def test_the_commands_train_resume_and_play_them(tmp_path, capsys):
    run = tmp_path / "tdc-shift" / "Pendulum-v1_1"
    settings = ["-params", "learning_starts:20", "batch_size:16", "policy_kwargs:{net_arch: [8], n_quantiles: 5}"]
    argv = [
        "--algo",
        "tdc-shift",
        "--env",
        "Pendulum-v1",
        "-f",
        str(tmp_path),
        "--eval-freq",
        "0",
        "--resume-freq",
        "40",
    ]
    assert train.main([*argv, "-n", "80", *settings]) == 0
    assert train.main(["--resume", str(run), "--from", "40"]) == 0
    assert enjoy.main([str(run), "--no-render", "--n-episodes", "1"]) == 0
    assert "tdc-shift on Pendulum-v1" in capsys.readouterr().out
