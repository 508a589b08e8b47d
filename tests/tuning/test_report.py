"""The page on searches: a sentence, tables, figures, details; and the CSV beside it."""

from __future__ import annotations

import csv
import random
import re
from pathlib import Path

import pytest
from tuning_support import choices, searched, small_run

from sb3_sparse.tuning import Space, open_storage, write_report
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.report import report_by_name
from sb3_sparse.tuning.search import DEFINITION, Search
from sb3_sparse.tuning.tuner import define
from sb3_sparse.tuning.words import facts, outcome
from sb3_sparse.zoo.results import score_of

SPACE = choices(weight_decay=[0.0, 1e-6, 1e-4], update_interval=[100, 200])
Float = optuna.distributions.FloatDistribution


@pytest.fixture
def storage(tmp_path):
    return open_storage(tmp_path / "tune" / "journal.log")


def finished(storage, name, value, run=None, space=SPACE, seeds=1):
    """A search whose trials have the score of a function of their values, and 10 more a seed."""
    return searched(
        storage,
        name,
        lambda values, seed: [value(values) + 10 * seed] * 6,
        run or small_run(),
        space,
        seeds,
    )


def decay_matters(values) -> float:
    """99 at its best, for a weight decay of 1e-6 and an interval of 100."""
    return 100 - abs(values["weight_decay"] - 1e-6) * 1e5 - values["update_interval"] / 100


def test_the_outcome_of_one_seed(storage):
    search = Search(finished(storage, "mine", decay_matters))
    assert outcome(search) == (
        "RigL at 90 % on CartPole-v1 (DQN, 600 steps): the best of 6 trials scores 99, with "
        "update interval 100, weight decay 1e-6."
    )


def test_the_outcome_of_a_single_trial_has_nothing_to_choose(storage):
    study = finished(storage, "one", lambda _: 12.345, space=choices(weight_decay=[1e-4]))
    assert outcome(Search(study)) == (
        "RigL at 90 % on CartPole-v1 (DQN, 600 steps): the only trial scores 12.3."
    )


def test_the_outcome_names_two_seeds_and_has_an_interval_of_three(storage):
    two = Search(finished(storage, "two", decay_matters, seeds=2))
    assert " scores 104 (its seeds: 99 and 109), with " in outcome(two)
    three = Search(finished(storage, "three", decay_matters, seeds=3))
    # mean 109, standard error 10 / sqrt(3) = 5.774, times 4.303 of Student's t: 24.84
    assert " scores 109 [84.2 to 134], with " in outcome(three)
    interval = "Intervals are Student's t at 95 % over the seeds of one trial."
    assert (interval in facts(two), interval in facts(three)) == (False, True)


def test_the_outcome_compares_with_the_config_as_it_is(storage):
    # The shipped config of RigL and DQN has weight decay 1e-6 and interval 1000.
    space = choices(weight_decay=[1e-6, 1e-4], update_interval=[100, 1000])
    search = Search(finished(storage, "mine", decay_matters, space=space))
    own = next(
        one.number
        for one in search.status().complete
        if one.params == {"weight_decay": 1e-6, "update_interval": 1000}
    )
    assert outcome(search).endswith(
        f"with update interval 100, weight decay 1e-6; the config as it is, trial {own}, scores 90."
    )
    level = Search(finished(storage, "level", lambda _: 7.0, space=space))
    texts = (", as the config has them.", ", scores the same.")
    assert outcome(level).endswith(texts)  # by which of the equal trials came first
    best = choices(weight_decay=[1e-6, 1e-4])
    other = finished(storage, "other", lambda values: -values["weight_decay"], space=best)
    assert outcome(Search(other)).endswith(", with weight decay 1e-6, as the config has them.")


def test_where_sparsity_is_searched_the_page_names_the_best(storage, tmp_path):
    space = choices(sparsity=[0.5, 0.75, 0.9])
    study = finished(storage, "s", lambda v: -abs(v["sparsity"] - 0.75), space=space)
    page = write_report([study], storage, tmp_path / "page.html").read_text()
    assert "RigL at 75 %" in page
    assert "RigL at 90 %" not in page


def rows_of(page, section):
    part = page[page.index(f'<section id="{section}">') :]
    body = part[part.index("<tbody>") : part.index("</tbody>")]
    rows = re.findall(r"<tr>(.*?)</tr>", body)
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in rows]


def test_the_page_and_its_csv(storage, tmp_path):
    study = finished(storage, "mine", decay_matters)
    run = small_run(method="static")
    finished(storage, "other", lambda v: -1.0, run, choices(weight_decay=[0.0]))
    finished(storage, "elsewhere", lambda v: 7.0, small_run(env_id="Acrobot-v1"))
    optuna.create_study(storage=storage, study_name="foreign")
    page = write_report([study], storage, tmp_path / "page.html").read_text()
    contents = re.findall(r'<a href="#(.*?)">', page)
    assert contents == ["the-6-best-trials", "figures", "best-of-each-method", "details"]
    assert page.index(outcome(Search(study))) < page.index("<nav")
    assert rows_of(page, "the-6-best-trials")[:2] == [
        [str(search_number(study, 1e-6, 100)), "<strong>99</strong>", "100", "1e-6"],
        [str(search_number(study, 0.0, 100)), "98.9", "100", "0"],
    ]
    assert rows_of(page, "best-of-each-method") == [
        ["RigL at 90\u00a0%", "<strong>99</strong>", "update interval 100, weight decay 1e-6"]
        + ["6 of 6", "mine"],
        ["Static at 90\u00a0%", "-1", "", "1 of 1", "other"],
    ]
    assert (
        "<p>The same in all rows: algorithm DQN; environment CartPole-v1; steps 600; "
        "seeds per trial 1.</p>"
    ) in page

    with (tmp_path / "page.csv").open() as file:
        trials = list(csv.DictReader(file))
    assert len(trials) == 6
    for trial in trials:
        values = {name: float(trial[name]) for name in ("weight_decay", "update_interval")}
        assert float(trial["score"]) == pytest.approx(decay_matters(values))
        assert (trial["study"], trial["state"], trial["evaluations"]) == ("mine", "complete", "6")


def search_number(study, decay, interval) -> int:
    values = {"weight_decay": decay, "update_interval": interval}
    return next(one.number for one in study.get_trials() if one.params == values)


def test_what_is_the_same_in_all_of_the_best_trials_is_said_once(storage, tmp_path):
    space = choices(weight_decay=[0.0, 1e-4], update_interval=[*range(100, 1200, 100)])
    study = finished(storage, "mine", lambda v: 1000 - 1e6 * v["weight_decay"], space=space)
    page = write_report([study], storage, tmp_path / "page.html").read_text()
    assert "<p>The same in all rows: score 1,000; weight decay 0.</p>" in page
    assert {len(row) for row in rows_of(page, "the-10-best-trials")} == {2}


def test_several_searches_are_compared_first(storage, tmp_path):
    one = finished(storage, "one", decay_matters)
    other = finished(storage, "other", decay_matters, small_run(method="set"))
    page = write_report([one, other], storage, tmp_path / "page.html").read_text()
    contents = re.findall(r'<a href="#(.*?)">', page)
    assert contents == ["best-of-each-method", "one", "other", "details"]
    assert page.count('class="lead"') == 2
    assert page.count("<h3>The 6 best trials</h3>") == 2
    names = re.findall(r'<figure id="(.*?)">', page)
    assert len(names) == len(set(names)) == 6


def test_a_large_search_makes_a_small_page_that_opens_without_a_network(tmp_path):
    run = small_run(n_timesteps=5000)  # 50 evaluations
    space = Space(
        "large",
        {
            "weight_decay": Float(1e-7, 1e-2, log=True),
            "learning_rate": Float(1e-5, 1e-2, log=True),
            "drop_fraction": Float(0.0, 0.5),
            "gamma": Float(0.9, 0.99),
        },
    )
    definition = define(run, space, 1, "random", "none", Path("logs"))
    storage = optuna.storages.InMemoryStorage()
    study = optuna.create_study(storage=storage, study_name="large", direction="maximize")
    study.set_user_attr(DEFINITION, definition.as_dict())
    draw = random.Random(0)
    for _ in range(200):
        returns = [draw.uniform(0, 500) for _ in range(50)]
        params = {
            name: draw.uniform(one.low, one.high) for name, one in space.distributions.items()
        }
        study.add_trial(
            optuna.trial.create_trial(
                value=score_of(returns),
                params=params,
                distributions=dict(space.distributions),
                user_attrs={"hyperparams": params, "scores": [score_of(returns)]},
                intermediate_values=dict(enumerate(returns, 1)),
            )
        )
    path = write_report([study], storage, tmp_path / "page.html")
    assert 100_000 < path.stat().st_size < 500_000
    page = path.read_text()
    assert page.count("<figure ") == page.count("data:image/svg+xml;base64,") == 4
    links = re.findall(r'(?:src|href)="([^"]{0,20})', page)
    assert {link.partition(":")[0] for link in links if link[0] != "#"} == {"data", "page.csv"}
    assert not re.search("<script[^>]|@import|url\\(", page)


def test_a_search_that_cannot_be_read_here_is_named_and_spoils_no_page(storage, tmp_path):
    study = finished(storage, "mine", decay_matters)
    other = finished(storage, "other", decay_matters)
    known = other.user_attrs[DEFINITION]
    other.set_user_attr(DEFINITION, {**known, "run": {**known["run"], "env_id": "Gone-v0"}})
    page = write_report([study], storage, tmp_path / "page.html").read_text()
    assert re.search("<p>Left out: other: .*Gone-v0", page)


def test_the_details_say_how_the_search_was_made(storage, tmp_path):
    study = finished(storage, "mine", decay_matters, seeds=2)
    study.enqueue_trial({})
    with pytest.raises(ZeroDivisionError):
        study.optimize(lambda trial: 1 / 0, n_trials=1)
    texts = facts(Search(study))
    assert texts[0] == (
        "Trials: 6 completed, 0 pruned, 1 failed, of 6 planned. Sampler grid, pruner none."
    )
    assert texts[1].startswith(
        "Each trial trains seeds 0 to 1 for 600 environment steps, evaluated every 100 steps over "
        "2 episodes. Its score"
    )
    assert texts[2:4] == ["update interval: 100, 200.", "weight decay: 0, 1e-6, 1e-4."]
    assert texts[-1] == "Trial 6 failed: no reason known."
    page = report_by_name(["mine"], None, tmp_path, tmp_path / "page.html").read_text()
    made_by = f"sb3-sparse tune report mine --log-folder {tmp_path} --out {tmp_path}/page.html"
    assert f"<code>{made_by}</code>" in page
