"""What a page says first of a study that tests a single finding, of made-up measurements."""

from __future__ import annotations

from sb3_sparse.report import Results, judge, read_runs
from sb3_sparse.report.leads import leads


def test_a_study_of_noise_says_what_noise_leaves_of_the_returns(folders):
    """At 80 %, the nearest to 90 %; the means of two seeds, at no noise and at 2.0."""
    for seed, more in enumerate((0.0, 20.0)):
        folders.add("rigl", 0.8, seed, noise={0.0: 400 + more, 1.0: 300, 2.0: 200 + more})
        folders.add("rigl", 0.5, seed, noise={0.0: 1, 2.0: 1})
        folders.add("dense", None, seed, match=0.8, noise={0.0: 300 + more, 2.0: 50 + more})
    folders.add("dense", None, 0, noise={0.0: 500, 2.0: 40})
    folders.add("set", 0.8, 0)  # without a measurement
    runs, _ = read_runs(folders.made)
    results = Results(tuple(runs), findings=("noise",))
    verdict, sentence = leads(results, judge(results))
    assert verdict.startswith("Sparse networks bear observation noise better than dense ones")
    assert sentence == (
        "CartPole-v1 at 80 %, mean returns without noise and with the strongest: RigL 410 and 210; "
        "dense 500 and 40; dense with as many parameters 310 and 60; 1 to 2 seeds."
    )


def test_networks_of_a_study_of_ratios_are_told_apart(folders):
    folders.add("rigl", 0.9, 0, algo="sac", share=0.5, snr={"snr/actor": 0.1, "snr/critic": 0.4})
    folders.add("dense", None, 0, algo="sac", share=0.5, snr={"snr/actor": 0.2, "snr/critic": 0.3})
    runs, _ = read_runs(folders.made)
    results = Results(tuple(runs), findings=("snr",))
    assert leads(results, judge(results))[1:] == [
        f"CartPole-v1, {network}, geometric mean of the ratio over training: {means}; 1 seed."
        for network, means in (("actor", "dense 0.2; 90 % 0.1"), ("critic", "dense 0.3; 90 % 0.4"))
    ]
