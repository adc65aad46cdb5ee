"""``train`` and ``enjoy`` from end to end, with small networks on Hopper."""

from sb3_tdc.cli import enjoy, train

SMALL = ["-params", "policy_kwargs:{net_arch: [16, 16], n_quantiles: 5}", "learning_starts:100", "batch_size:16"]


SMALL_ANY = ["-params", "policy_kwargs:{net_arch: [16, 16]}", "learning_starts:100", "batch_size:16"]


def run_train(folder, *args, algo="tdc", env="Hopper-v4", n=300, small=SMALL, seed=1):
    argv = ["--algo", algo, "--env", env, "-n", n, "--seed", seed, "-f", folder, "--eval-freq", 150]
    argv += ["--eval-episodes", 2, "--device", "cpu", *small, *args]
    return train.main([str(a) for a in argv])


def run_enjoy(*args):
    return enjoy.main([*map(str, args), "--no-render", "--n-episodes", "2", "--device", "cpu"])
