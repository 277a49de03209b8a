"""Campaigns as files and sweeps: what they are, and what is drawn."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy import stats
from scipy.spatial.transform import Rotation
from support.campaigns import campaign, flown, section

from spacerobot_ros.campaign import running as module
from spacerobot_ros.campaign.config import load_campaign
from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.running import sweep
from spacerobot_ros.campaign.targets import description_of
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.scenario import load_scenario

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "campaigns"
NORM = {"norm": {"loc": 1.0, "scale": 0.05}}


def joint(names: str = "goal.position.x, goal.position.y", **given: Any) -> dict[str, Any]:
    return {"disperse": {names: {"multivariate_normal": given}}}


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"flight": 3}, "there is no key 'flight'.*Did you mean 'flights'"),
    ({"flights": 0}, "'flights' is 0; it must be a whole number from 1"),
    ({"flights": True}, "'flights' is True"),
    ({"seed": -1}, "'seed' is -1"),
    ({"sampler": "sobl"}, "no sampler 'sobl'.*Did you mean 'sobol'"),
    ({"engine": "flight"}, "no engine 'flight'.*Did you mean 'flights'"),
    ({"scenario": "faults/stuck_slidr"}, "Did you mean"),
    ({"set": {"plant.tick_rat": 1}}, "no parameter 'tick_rat'"),
    ({"set": {"tick_rate": 1}}, "'tick_rate' is not a parameter"),
    ({"set": {"plant.time_mode": "realtime"}}, "campaigns are flown in lockstep"),
    ({"disperse": {"mas": NORM}}, "'mas' cannot be dispersed.*Did you mean 'mass'"),
    ({"disperse": {"mass.mass_7": NORM}}, "'mass.mass_7' is not one of.*Did you mean 'mass.mass_"),
    ({"disperse": {"mass": {"nrom": {}}}}, "no distribution 'nrom'.*Did you mean 'norm'"),
    ({"disperse": {"mass": {"norm": {"scal": 1}}}}, "not {'scal': 1}.*Did you mean 'scale'"),
    ({"disperse": {"mass": {"norm": 3}}}, "norm takes loc, scale, not 3"),
    ({"disperse": {"mass": {"norm": {"loc": "one"}}}}, "'mass: loc' is 'one'"),
    ({"disperse": {"mass": {"beta": {"a": 1}}}}, "beta takes a, b, loc, scale, not {'a': 1}"),
    ({"disperse": {"mass": {"norm": [1, 2, 3]}}}, r"norm takes loc, scale, not \[1, 2, 3\]"),
    ({"disperse": {"mass": {"uniform": [1]}}}, r"uniform takes two numbers, \[smallest, largest\]"),
    (
        {"disperse": {"mass": {"uniform": [2, 1]}}},
        "uniform ranges from 2 to 1; the first number must be smaller",
    ),
    ({"disperse": {"mass": 1.0}}, "must have one distribution"),
    ({"disperse": {"mass": NORM, "mass.mass_1": NORM}}, "set the same values"),
    ({"disperse": {"mass.mass_1": NORM, "mass": NORM}}, "'mass.mass_1' and 'mass' set the same"),
    ({"disperse": {"mass.": NORM}}, "'mass.' is not one of mass, mass.base_link"),
    ({"disperse": 0}, "'disperse' must map names to values"),
    ({"criteria": []}, "'criteria' must map names to values"),
    ({"disperse": {"mass": {"gaussian": {}}}}, "Did you mean 'norm'"),
    ({"disperse": {"mass": {"norm": {"mean": 1}}}}, "loc is the mean and scale is the standard"),
    (
        {"disperse": {"mass": {"uniform": {"max": 1}}}},
        "loc is the smallest value and scale is the width",
    ),
    ({"table": "none.csv"}, "the table 'none.csv' cannot be read: No such file"),
    ({"table": "/dev/zero"}, "the table '/dev/zero' cannot be read: it is a device"),
    ({"table": 3}, "'table' must be the name or the content of a CSV file"),
    ({"table": "mass\n"}, "must consist of one line of names and one line per flight"),
    ({"table": "\n"}, "must consist of one line of names and one line per flight"),
    ({"table": "mass\n1,2\n"}, "table row 1 has 2 values for 1 names"),
    ({"table": "mass.*\n1\n"}, r"'mass.\*' in the table refers to 4 values: name one"),
    ({"table": "mass\nx\n"}, "'mass: table' is 'x'; it must be a finite number"),
    ({"table": "mass\n1\n", "disperse": {"mass.mass_1": NORM}}, "set the same values"),
    ({"table": "planner.method\noptima\n"}, "must be one of lie_bracket"),
    ({"table": "mass\n1\n", "sampler": "saltelli"}, "'saltelli' requires independent values"),
    (joint(cov=[[1, 2], [2.5, 8]]), "cov must be symmetric"),
    (joint(cov=[[1, 2], [2, 1]]), "positive semidefinite"),
    (joint(cov=[1, 2]), "mean must have 2 numbers, cov 2 x 2"),
    (joint(mean=[1], cov=[[1, 0], [0, 1]]), "mean must have 2 numbers, cov 2 x 2"),
    (joint(cov=[[1, 0], [0, 0]]), "means must be finite and variances positive"),
    (joint(mean=[1, 2]), "multivariate_normal must have 'cov' and may have 'mean'"),
    (joint("mass, planner.method", cov=[[1, 0], [0, 1]]), "includes a string"),
    ({"disperse": {"mass": {"norm": {"loc": 1, "scale": 0}}}}, "norm is not defined for these"),
    ({"disperse": {"mass": {"choice": [1, None]}}}, "'mass: choice' is None"),
    ({"disperse": {"mass": {"choice": [True, 1]}}}, "'mass: choice' is True"),
    ({"disperse": {"mass": {"choice": [[1], 2]}}}, r"'mass: choice' is \[1\]"),
    ({"disperse": {"mass": {"choice": [float("inf")]}}}, "it must be a finite number"),
    ({"disperse": {"planner.method": {"choice": ["optimal", 3]}}}, "is a string; the choice has 3"),
    ({"disperse": {"planner.method": {"choice": ["optimall"]}}}, "must be one of lie_bracket"),
    ({"disperse": {"plant.sensors.position_noise": {"choice": [-1]}}}, "must be a number from 0"),
    ({"disperse": {"plant.sensors.position_bias[3]": NORM}}, "not an index from 0 to 2"),
    ({"disperse": {"plant.sensors.position_bias[slider_1]": NORM}}, "not an index from 0 to 2"),
    ({"disperse": {"plant.sensors.joint_bias[3]": NORM}}, "nor one of the joints slider_1"),
    (
        {"disperse": {"planner.optimal.max_velocity[0]": NORM}},
        "the list is empty, and an empty list has",
    ),
    (
        {
            "set": {"planner.optimal.max_velocity": ["slider_2:0.1"]},
            "disperse": {"planner.optimal.max_velocity[0]": NORM},
        },
        "the list consists of strings NAME:VALUE; set a number for each",
    ),
    ({"disperse": {"plant.robot": {"choice": ["dual_arm"]}}}, "the same in all flights"),
    ({"disperse": {"plant.time_mode": {"choice": ["realtime"]}}}, "the same in all flights"),
    ({"disperse": {"initial.joint.slider_1": NORM}}, "Did you mean 'initial.joints.slider_1'"),
    ({"disperse": {"com.x": NORM}}, "'com.x' is not one of com.base_link.x, com.base_link.y"),
    ({"disperse": {"initial.position.x": NORM, "plant.initial_position[0]": NORM}}, "same values"),
    (
        {
            "disperse": {
                "initial.joints.slider_1": NORM,
                "plant.initial_joint_positions[slider_1]": NORM,
            }
        },
        "set the same values",
    ),
    ({"disperse": {"plant.sensors.noise": NORM}}, "no parameter 'sensors.noise'.*Did you mean"),
    ({"disperse": {"coordinated_control.time_limit": NORM}}, "a node that is not in use"),
    ({"disperse": {"plant.linear_momentum": NORM}}, "name an element of the list"),
    ({"disperse": {"plant.tick_rate[0]": NORM}}, "it is not a list"),
    ({"disperse": {"plant.initial_orientation[0]": NORM}}, "disperse initial.rotvec"),
    ({"disperse": {"goal.position.u": NORM}}, "is not one of goal.position.x"),
    ({"disperse": {"goal.*": NORM}}, r"'goal.\*' stands for .* different units \(m, rad\)"),
    ({"disperse": {"end_effector_goal.position.x": NORM}}, "no goal for the end-effector"),
    ({"disperse": {"faults[0].at": NORM}}, r"plant.faults has 0 faults"),
    (
        {
            "disperse": {"faults[0].target": {"choice": ["slider_1", "slider_9"]}},
            "set": {"plant.faults": ["joint_stuck slider_1"]},
        },
        "'joint_stuck slider_9' is refused: the target of joint_stuck must be one of slider_1",
    ),
    (
        {
            "disperse": {"faults[0].kind": {"choice": ["joint_slow"]}},
            "set": {"plant.faults": ["joint_stuck slider_1"]},
        },
        "joint_slow needs a value: factor on the command",
    ),
    ({"disperse": {"planner.method": NORM}}, "is a string: it must have a 'choice' of strings"),
    ({"disperse": {"faults[0].present": NORM}}, r"plant.faults has 0 faults"),
    ({"disperse": {"mass": {"choice": ["a"]}}}, "'mass: choice' is 'a'"),
    ({"criteria": {"position_eror_m": {"max": 1}}}, "no metric.*Did you mean 'position_error_m'"),
    ({"criteria": {"peak_rate.slider_9": {"max": 1}}}, "Did you mean 'peak_rate.slider_[123]'"),
    ({"criteria": {"duration_s": {"most": 1}}}, "must have 'min', 'max' or both"),
    ({"criteria": {"duration_s": {"min": 2, "max": 1}}}, "has min 2.0 above max 1.0"),
    ({"sampler": "saltelli"}, "requires at least one dispersion"),
    ({"scenario": None}, "'scenario' must be a scenario name or file"),
    ({"disperse": {"mass.mass_1": NORM, "mass.*": NORM}}, "'mass.mass_1' is dispersed twice"),
    ({"disperse": {"mass": {"choice": []}}}, "'mass' must have a list of values to choose from"),
    ({"disperse": {"mass": {"choice": 3}}}, "'mass' must have a list of values to choose from"),
    ({"disperse": {"mass": {"poisson": [1, 2, 3]}}}, r"poisson takes mu, loc, not \[1, 2, 3\]"),
    ({"longest": -1}, "'longest' is -1; it must be a finite number of at least 0"),
    ({"longest": True}, "'longest' is True; it must be a finite number of at least 0"),
    ({"flights": 10_000_001}, "'flights' is 10000001; it must be a whole number from 1 to 1"),
    ({"flights": 2.0}, "'flights' is 2.0; it must be a whole number from 1 to 10000000"),
    ({"seed": 2**63}, "'seed' is 9223372036854775808; it must be a whole number from 0 to 9"),
    ({"criteria": {"duration_s": {"min": "a"}}}, "'duration_s: min' is 'a'; it must be a finite"),
    ({"disperse": {"plant.tf_links": NORM}}, "is neither a number nor a string"),
    ({"disperse": {"com.mass_1.w": NORM}}, "is not one of.*Did you mean 'com.mass_1"),
    ({"disperse": {"initial.velocity.x": NORM}}, "initial.position.x, initial.position.y"),
    (
        {"disperse": {"faults[0].value": NORM}, "set": {"plant.faults": ["joint_stuck slider_1"]}},
        "a fault of kind joint_stuck does not take a value",
    ),
]


@pytest.mark.parametrize(("given", "sentence"), REFUSED, ids=lambda x: str(x)[:40])
def test_what_is_wrong_is_said(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=f"(?s){sentence}"):
        campaign(**given)


@pytest.mark.filterwarnings("error")
def test_what_is_wrong_is_said_in_one_sentence_without_a_warning() -> None:
    for given in ({"norm": {"scale": -1}}, {"triang": {"c": 3}}):
        with pytest.raises(ParameterError, match="is not defined for these arguments"):
            campaign(disperse={"mass": given})
    made = campaign(disperse={"mass": {"pareto": {"b": 0.001}}}, flights=9)
    assert any(np.isinf(draw.values["mass"]) for draw in Draws(made))


def test_a_description_has_no_control_characters() -> None:
    assert campaign(description="red \x1b[31m\nblue").description == "red \ufffd[31m blue"


def test_numbers_without_a_dot_may_be_chosen() -> None:
    """YAML reads 9e-1 as a text."""
    made = campaign(disperse={"mass": {"choice": ["9e-1", 1]}})
    assert made.dispersions[0].distribution.choices == (0.9, 1.0)


def test_a_campaign_is_not_read_from_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "campaign.yaml")
    with pytest.raises(ParameterError, match=r"campaign\.yaml cannot be read: it is a pipe"):
        load_campaign(tmp_path / "campaign.yaml")


def test_a_file_names_its_scenario_beside_it(tmp_path: Path) -> None:
    plant = {"robot": "sliding_masses"}
    (tmp_path / "own.yaml").write_text(
        yaml.safe_dump(
            {
                "scenario": {"ros__parameters": {"goal_position": [0.01, 0.0, 0.0]}},
                "plant": {"ros__parameters": plant},
                "planner": {"ros__parameters": plant},
            }
        )
    )
    file = tmp_path / "many.yaml"
    content = {**section(scenario="own.yaml", flights=7), "method": "lie_bracket"}
    file.write_text(yaml.safe_dump({"campaign": content}))
    made = load_campaign(file)
    assert (made.name, made.scenario.name, made.flights) == ("many", "own", 7)
    assert made.scenario.planner.method == "lie_bracket"
    assert load_campaign(file, 9).flights == 9
    file.write_text("campaign: {scenario: 3}")
    with pytest.raises(ParameterError, match=f"The campaign file {file} is refused: 'scenario'"):
        load_campaign(file)
    file.write_text("campaign: [1]")
    with pytest.raises(ParameterError, match=f"{file} has no section"):
        load_campaign(file)


DISPERSED = {
    "mass.*": {"norm": {"loc": 1.0, "scale": 0.05}},
    "goal.position.x": {"triang": {"c": 0.25, "loc": -0.01, "scale": 0.02}},
    "planner.method": {"choice": ["lie_bracket", "optimal"]},
}


@pytest.mark.parametrize("sampler", ["random", "sobol", "halton"])
def test_a_draw_does_not_depend_on_how_many_there_are(sampler: str) -> None:
    few, many = (
        Draws(campaign(disperse=DISPERSED, sampler=sampler, flights=n, seed=4)) for n in (9, 40)
    )
    for number in (0, 5, 8):
        assert few[number] == many[number]
    other = Draws(campaign(disperse=DISPERSED, sampler=sampler, flights=9, seed=5))
    assert other[5].values != few[5].values
    assert other[5].seed != few[5].seed


def test_draws_that_are_made_together_are_those_that_are_made_alone() -> None:
    """Values are computed for many draws at once, and are those that scipy gives for each."""
    made = campaign(disperse={"mass.*": NORM, "com.*": {"t": [4.0, 0.0, 0.01]}}, flights=300)
    whole = list(Draws(made))
    assert [draw.number for draw in whole] == list(range(300))
    for number in (299, 256, 255, 3):
        draw = Draws(made)[number]
        assert draw == whole[number]
        own = np.random.SeedSequence(made.seed, spawn_key=(number,))
        shares = np.random.default_rng(own.spawn(1)[0]).random(len(made.dispersions))
        for each, u in zip(made.dispersions, shares, strict=True):
            kind = getattr(stats, each.distribution.name)
            expected = kind(**each.distribution.arguments).ppf(u)
            assert draw.values[each.name] == pytest.approx(expected, rel=1e-13)
    with pytest.raises(IndexError):
        Draws(made)[300]


def test_a_list_of_uniform_is_from_its_least_to_its_largest_value() -> None:
    """The mapping is that of scipy; both are equal here, and slices of a tenth have one draw."""
    given = {"mass": {"uniform": [1.1, 3.6]}, "inertia": {"uniform": {"loc": 1.1, "scale": 2.5}}}
    for name in given:
        made = campaign(disperse=given, sampler="latin_hypercube", flights=10)
        drawn = sorted(draw.values[name] for draw in Draws(made))
        edges = np.linspace(1.1, 3.6, 11)
        assert np.all((edges[:-1] < drawn) & (drawn < edges[1:]))


NAMES = ("goal.position.x", "goal.position.y", "initial.rotvec.z")
MEAN = np.array([0.001, -0.002, 0.01])
COVARIANCE = np.array([[4.0, -3.0, 1.0], [-3.0, 9.0, 2.0], [1.0, 2.0, 25.0]]) * 1e-6


@pytest.mark.parametrize("sampler", ["random", "latin_hypercube", "sobol", "halton"])
def test_correlated_values_are_those_of_scipys_distribution(sampler: str) -> None:
    """By the cumulative distribution, and by distances, whose squares are those of chi squared."""
    normal = {"multivariate_normal": {"mean": MEAN.tolist(), "cov": COVARIANCE.tolist()}}
    disperse = {"mass": NORM, ", ".join(NAMES): normal}
    made = campaign(disperse=disperse, sampler=sampler, flights=512, seed=3)
    assert made.names == ("mass", *NAMES)
    drawn = np.array([[draw.values[name] for name in made.names] for draw in Draws(made)])
    expected, values = stats.multivariate_normal(MEAN, COVARIANCE), drawn[:, 1:]
    squared = np.einsum("ni,ij,nj->n", values - MEAN, np.linalg.inv(COVARIANCE), values - MEAN)
    assert stats.kstest(squared, stats.chi2(3).cdf).pvalue > 0.01
    for corner in ([0.0, 0.0, 0.01], [0.001, -0.004, 0.02], [0.003, 0.001, 0.008]):
        share = np.mean(np.all(values <= corner, axis=1))
        assert share == pytest.approx(expected.cdf(corner), abs=0.06)
    np.testing.assert_allclose(np.cov(values.T), COVARIANCE, atol=4e-6)
    assert np.abs(np.corrcoef(drawn.T)[0, 1:]).max() < 0.15
    assert stats.kstest(drawn[:, 0], stats.norm(1.0, 0.05).cdf).pvalue > 0.01


def test_a_covariance_may_be_singular() -> None:
    normal = {"multivariate_normal": {"cov": [[4e-6, -6e-6], [-6e-6, 9e-6]]}}
    made = campaign(disperse={"goal.position.x, goal.position.y": normal}, flights=5)
    x, y = np.array([[*draw.values.values()] for draw in Draws(made)]).T
    np.testing.assert_allclose(y, -1.5 * x, rtol=1e-9)


def test_the_rows_of_a_table_are_its_flights(tmp_path: Path) -> None:
    """Beside values that are drawn; the campaign has the table, wherever its file was."""
    (tmp_path / "draws.csv").write_text(
        "mass.mass_1, planner.method, goal.position.x\n1.25, optimal, 1e-3\n0.75, auto, -2e-3\n"
    )
    file = tmp_path / "many.yaml"
    content = section(table="draws.csv", disperse={"mass.mass_2": NORM})
    del content["set"]
    file.write_text(yaml.safe_dump({"campaign": content}))
    made = load_campaign(file)
    assert (made.flights, load_campaign(file, 1).flights) == (2, 1)
    again = campaign(**made.section)
    assert again.dispersions[0].distribution == made.dispersions[0].distribution
    draws = [dict(draw.values) for draw in Draws(made)]
    second = [draw.pop("mass.mass_2") for draw in draws]
    assert draws == [
        {"mass.mass_1": 1.25, "planner.method": "optimal", "goal.position.x": 0.001},
        {"mass.mass_1": 0.75, "planner.method": "auto", "goal.position.x": -0.002},
    ]
    assert second[0] != second[1]
    with pytest.raises(ParameterError, match="'flights' is 3, but the table has only 2 rows"):
        load_campaign(file, 3)


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.yaml")), ids=lambda file: file.stem)
def test_examples_are_read_and_drawn(file: Path) -> None:
    made = load_campaign(file, 8)
    first, second = (drawn_flight(made, Draws(made)[number]) for number in (0, 1))
    masses = [None if x.inertial is None else x.inertial.masses.tolist() for x in (first, second)]
    assert masses[0] != masses[1] or first.scenario != second.scenario


def test_saltelli_draws_are_whole_blocks() -> None:
    made = campaign(disperse={"mass.*": NORM}, sampler="saltelli", flights=60)
    assert len(Draws(made)) == 8 * 6  # The largest power of two that 60 flights of 4 + 2 allow.
    with pytest.raises(ParameterError, match="at least 12 flights for 4"):
        Draws(campaign(disperse={"mass.*": NORM}, sampler="saltelli", flights=11))


# -- A small campaign from Python, in the words of a flight --------------------------------------


NOISE = {"plant.sensors.position_noise": {"uniform": [0.001, 0.004]}}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Path]]:
    """Campaigns and folders of sweeps, which are not flown."""
    found: list[tuple[Any, Path]] = []

    class Rows:
        def __init__(self, folder: Path) -> None:
            self.folder = folder

        def table(self) -> str:
            return f"rows of {self.folder.name}"

    monkeypatch.setattr(module, "run_campaign", lambda *given: found.append(given))
    monkeypatch.setattr(module, "Dataset", Rows)
    return found


def test_a_sweep_is_a_campaign(run: list[tuple[Any, Path]], tmp_path: Path) -> None:
    at = (0.25, -0.5, 0.125)
    rows = sweep(
        "sliding_masses",
        NOISE,
        position=at,
        method="lie_bracket",
        parameters={"planner.position_tolerance": 0.0125},
        seed=5,
        flights=7,
        folder=str(tmp_path / "kept"),
        sampler="sobol",
        criteria={"position_error_m": {"max": 0.02}},
    )
    assert rows == "rows of kept"
    ((campaign, folder),) = run
    assert folder == tmp_path / "kept"
    assert (campaign.name, campaign.flights, campaign.seed) == ("sliding_masses", 7, 5)
    assert campaign.sampler == "sobol"
    assert campaign.names[0] == "plant.sensors.position_noise"
    assert campaign.scenario.planner.method == "lie_bracket"
    np.testing.assert_allclose(campaign.scenario.goal.position, at)
    assert campaign.scenario.planner.position_tolerance == 0.0125
    assert [each.metric for each in campaign.criteria] == ["position_error_m"]


def test_a_sweep_takes_goals_of_end_effectors_and_refuses_unknown_parameters(
    run: list[tuple[Any, Path]],
) -> None:
    place = (1.0, 0.6, 0.7)
    sweep("reach", NOISE, end_effector_position=place, end_effector="link_7")
    (aim,) = run[0][0].scenario.goal.end_effectors
    assert aim.link == "link_7"
    np.testing.assert_allclose(aim.position, place)
    with pytest.raises(ParameterError, match="position_toleranse"):
        sweep("sliding_masses", NOISE, parameters={"planner.position_toleranse": 0.1})


def test_a_sweep_without_a_folder_leaves_nothing(run: list[tuple[Any, Path]]) -> None:
    sweep("sliding_masses", NOISE)
    ((campaign, folder),) = run
    assert (campaign.flights, campaign.seed) == (100, 0)
    assert not folder.parent.exists()


def test_a_robot_without_a_goal_and_an_unknown_key_are_refused() -> None:
    with pytest.raises(ParameterError, match="goal"):
        sweep("surveyor", NOISE)
    with pytest.raises(ParameterError, match="there is no key 'flight'"):
        sweep("sliding_masses", NOISE, flight=3)


def test_a_sweep_takes_numbers_of_numpy(run: list[tuple[Any, Path]]) -> None:
    """They can be stored in a file, as numbers."""
    ends, mean = np.array([0.001, 0.002]), {"loc": np.float64(1.0), "scale": np.float32(0.25)}
    drawn = {"plant.sensors.position_noise": {"uniform": ends}, "mass": {"norm": mean}}
    counts: dict[str, Any] = {"seed": np.int64(5), "flights": np.int32(7)}
    sweep("sliding_masses", drawn, **counts)
    ((campaign, _),) = run
    assert (campaign.flights, campaign.seed) == (7, 5)
    kept = yaml.safe_load(yaml.safe_dump(campaign.section["disperse"]))
    assert kept["mass"] == {"norm": {"loc": 1.0, "scale": 0.25}}
    assert kept["plant.sensors.position_noise"] == {"uniform": [0.001, 0.002]}


@pytest.mark.slow
def test_a_sweep_is_flown() -> None:
    table = sweep("coordinated_control", NOISE, flights=3, engine="flights").to_pandas()
    assert list(table["flight"]) == [0, 1, 2]
    assert table["draw.plant.sensors.position_noise"].between(0.001, 0.004).all()


# -- what is drawn is read back from what the plant did: each kind of dispersion by itself -------


ROBOT = description_of(load_scenario("faults/stuck_slider"))
BODIES = [body.name for body in ROBOT.bodies]

Check = Callable[[Flight, dict[str, Any]], None]

COAST = {"plant.linear_momentum": [3.0, 0.0, 0.0], "planner.max_corrections": 0}
SPIN = {"plant.angular_momentum": [0.0, 0.0, 0.2], "planner.max_corrections": 0}


def factors(kind: str, drawn: dict[str, Any]) -> np.ndarray:
    return np.array([drawn.get(f"{kind}.{name}", 1.0) for name in BODIES])


def centres() -> np.ndarray:
    """Centres of mass of the bodies in the base at the start, where all sliders are at zero."""
    robot = SpaceRobot(ROBOT)
    poses = [robot.link_pose(body.name, np.zeros(3)) for body in ROBOT.bodies]
    return np.array(
        [r + R @ body.inertia.com for (R, r), body in zip(poses, ROBOT.bodies, strict=True)]
    )


MASSES = np.array([body.inertia.mass for body in ROBOT.bodies])


def mass_from_momentum(flight: Flight, drawn: dict[str, Any]) -> None:
    """At rest all bodies move alike: p = m v."""
    mass = 3.0 / flight.twist[0, 0]
    assert mass == pytest.approx(factors("mass", drawn) @ MASSES, rel=1e-12)


def inertia_from_angular_momentum(flight: Flight, drawn: dict[str, Any]) -> None:
    """At rest the robot spins as one body: L = I omega, of which the third row is known."""
    r = centres() - MASSES @ centres() / MASSES.sum()
    tensor = np.zeros((3, 3))
    for body, x, factor in zip(ROBOT.bodies, r, factors("inertia", drawn), strict=True):
        steiner = body.inertia.mass * (x @ x * np.eye(3) - np.outer(x, x))
        tensor += factor * body.inertia.about_com + steiner
    np.testing.assert_allclose(tensor @ flight.twist[0, 3:], [0, 0, 0.2], atol=1e-13)


def centre_of_mass_from_spin(flight: Flight, drawn: dict[str, Any]) -> None:
    """The base's origin goes round the centre of mass: v = -omega x r_BC."""
    offsets = [[drawn.get(f"com.{name}.{axis}", 0.0) for axis in "xyz"] for name in BODIES]
    r_BC = MASSES @ (centres() + np.array(offsets)) / MASSES.sum()
    v, omega = flight.twist[0, :3], flight.twist[0, 3:]
    np.testing.assert_allclose(v, -np.cross(omega, r_BC), atol=1e-14)


def noise_from_statistics(flight: Flight, drawn: dict[str, Any]) -> None:
    errors = flight.quantities["measured_pose"][:, :3] - flight.pose[:, :3]
    sigma = drawn["plant.sensors.position_noise"]
    # Of 200 numbers and more the standard deviation is known to 5 %.
    assert errors.size > 200
    assert errors.std() == pytest.approx(sigma, rel=0.2)
    assert abs(errors.mean()) < 0.3 * sigma


def goal_from_the_end(flight: Flight, drawn: dict[str, Any]) -> None:
    nominal = load_scenario("faults/stuck_slider").goal
    assert flight.goal is not None
    moved = flight.goal.position - nominal.position
    np.testing.assert_allclose(moved, [0, 0, drawn["goal.position.z"]], atol=1e-15)
    assert flight.succeeded
    # As far as the paper's first-order gait goes: a third of what was drawn.
    error = flight.pose[-1, 2] - nominal.position[2] - drawn["goal.position.z"]
    assert abs(error) < abs(drawn["goal.position.z"]) / 3


def goal_attitude_from_the_end(flight: Flight, drawn: dict[str, Any]) -> None:
    nominal = Rotation.from_quat(load_scenario("faults/stuck_slider").goal.quaternion)
    turned = Rotation.from_rotvec([drawn["goal.rotvec.x"], 0.0, 0.0])
    left = (nominal * turned).inv() * Rotation.from_quat(flight.pose[-1, 3:])
    assert left.magnitude() < drawn["goal.rotvec.x"] / 3


def start_from_the_first_state(flight: Flight, drawn: dict[str, Any]) -> None:
    assert flight.pose[0, 0] == drawn["initial.position.x"]
    rotvec = Rotation.from_quat(flight.pose[0, 3:]).as_rotvec()
    np.testing.assert_allclose(rotvec, [0, drawn["initial.rotvec.y"], 0], atol=1e-15)
    assert flight.q[0, 1] == pytest.approx(drawn["initial.joints.slider_2"], abs=1e-15)


def fault_from_when_a_joint_sticks(flight: Flight, drawn: dict[str, Any]) -> None:
    (begins,) = [e.time_s for e in flight.events if e.kind is EventKind.FAULT_INJECTED]
    at = drawn["faults[0].at"]
    assert begins is not None
    assert at <= begins < at + flight.control_period
    stuck = flight.time > begins + 1e-9
    assert not flight.qdot[stuck, 0].any()
    assert flight.qdot[~stuck, 0].any()


def uniform(low: float, high: float) -> dict[str, Any]:
    return {"uniform": {"loc": low, "scale": high - low}}


FAULT = {
    "plant.faults": ["joint_stuck slider_1 at 1 until 100"],
    **{"planner.max_corrections": 0, "planner.optimal.starts": 1, "planner.optimal.answers": 1},
}

KINDS: list[Any] = [
    pytest.param({"mass.*": uniform(0.5, 0.9)}, COAST, mass_from_momentum, id="mass"),
    pytest.param(
        {"inertia.*": uniform(1.1, 1.5)}, SPIN, inertia_from_angular_momentum, id="inertia"
    ),
    pytest.param({"com.*": uniform(0.01, 0.03)}, SPIN, centre_of_mass_from_spin, id="com"),
    pytest.param(
        {"plant.sensors.position_noise": uniform(0.001, 0.002)}, {}, noise_from_statistics,
        id="noise",
    ),
    pytest.param({"goal.position.z": uniform(0.015, 0.02)}, {}, goal_from_the_end, id="goal"),
    pytest.param(
        {"goal.rotvec.x": uniform(0.02, 0.03)}, {}, goal_attitude_from_the_end, id="goal-attitude"
    ),
    pytest.param(
        {
            "initial.position.x": uniform(0.001, 0.002),
            "initial.rotvec.y": uniform(0.001, 0.002),
            "initial.joints.slider_2": uniform(0.01, 0.02),
        },
        {}, start_from_the_first_state, id="start",
    ),
    pytest.param(
        {"faults[0].at": uniform(0.5, 0.9)}, FAULT, fault_from_when_a_joint_sticks, id="fault",
        marks=pytest.mark.slow,
    ),
]  # fmt: skip


def test_faults_take_place_on_what_was_drawn() -> None:
    """A joint stands still from the time of its fault on; all move in a flight without one."""
    drawn = {
        "faults[0].present": {"bernoulli": {"p": 0.5}},
        "faults[1].present": {"bernoulli": {"p": 0.5}},
        "faults[1].target": {"choice": ["slider_1", "slider_2"]},
    }
    faults = {**FAULT, "plant.faults": ["joint_stuck slider_3 at 1", "joint_stuck slider_1 at 1"]}
    made = campaign(disperse=drawn, set=faults, flights=4, seed=13)
    seen = set()
    for number in range(4):
        flight, values = flown(made, number)
        still = {f"slider_{i + 1}" for i in range(3) if not flight.qdot[flight.time > 1.2, i].any()}
        targets = ("slider_3", values["faults[1].target"])
        present = [bool(values[f"faults[{i}].present"]) for i in range(2)]
        assert still == {targets[i] for i in range(2) if present[i]}
        seen.add(frozenset(still))
    assert len(seen) == 4


@pytest.mark.parametrize(("disperse", "settings", "check"), KINDS)
def test_what_is_drawn_is_what_is_flown(
    disperse: dict[str, Any], settings: dict[str, Any], check: Check
) -> None:
    flight, drawn = flown(campaign(disperse=disperse, set=settings, seed=5))
    assert len(drawn) >= len(disperse)
    check(flight, drawn)
