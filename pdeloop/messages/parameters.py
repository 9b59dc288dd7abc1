# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The parameters of all nodes: name, type, default, range, unit and meaning, in one table.

A problem is one YAML file (pdeloop.messages.spec), read unchanged by the three nodes
(`--params-file`) and by the command line. The nodes declare from this table, the command line
validates by it and docs/parameters.md lists it. Each parameter names the nodes that take it
(`nodes`) and under which heading of `pdeloop train --help` its flag stands (`group`), so that a new
one is an entry here and its use. No ROS import.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pdeloop.messages.spec import Spec, check

MAX_SEED = 2**53 - 1
ROLLOUTS = 20
"""The budget of a seed that is given neither rollouts nor iterations."""
NODES = {
    "P": "pde_sim_node",
    "C": "controller_node",
    "T": "tuner_node",
    "R": "recorder_node",
    "V": "viewer_node",
}
"""Letters by which a parameter says which nodes take it."""


def _section(nodes: str, *specs: Spec) -> tuple[Spec, ...]:
    """Parameters that these nodes take, where one does not say otherwise."""
    return tuple(spec if spec.nodes else replace(spec, nodes=nodes) for spec in specs)


INSTRUMENTS = _section(
    "PT",
    Spec("measurement_noise", 0.0, 0.0, 1e6, nodes="PCT", group="problem").means(
        "standard deviation of the noise on every number of the published state; 0: none"
    ),
    Spec("process_noise", 0.0, 0.0, 1e6, group="problem").means(
        "intensity sigma of the white noise in space and time that forces the field: N(0, sigma^2 "
        "sample_time / dx) per step and grid point; 0: none"
    ),
    Spec("action_limit", 0.0, 0.0, 1e9, nodes="PCT", group="problem").means(
        "magnitude at which actions saturate; 0: no limit"
    ),
    Spec("action_bounds", [], -1e300, 1e300, nodes="PCT").means(
        "lowest actions, highest actions, 1 if their mean is zero, else 0, and largest changes in a "
        "step if there are any; filled in by a plant of your own; -1e300 and 1e300: no bound; empty: "
        "none"
    ),
    Spec("sensors", 0, 0, 65536, nodes="PCT", group="problem").means(
        "number n_y of equally spaced point sensors; 0: the whole state is measured"
    ),
    Spec("sensor_delays", 1, 1, 1024, nodes="PCT", group="problem").means(
        "number d of successive measurements of each sensor in the published state"
    ),
)
"""Instruments between the field and its controller (docs/robustness.md)."""

ACTUATORS = _section(
    "PT",
    Spec("actuator_positions", [], 0.0, 1.0, group="problem").means(
        "centres of the actuators as fractions of L; empty: n_x // n_a points apart, or the "
        "equation's"
    ),
    Spec(
        "actuator_shape", "equation", choices=("equation", "indicator", "gaussian"), group="problem"
    ).means(
        "indicator: 1 on the actuator's width; gaussian: the width is the standard deviation; "
        "equation: the equation's own shape, by default an indicator"
    ),
)
"""Positions and shapes of the actuators, where they differ from the equation's."""

IDENTIFICATION = Spec(
    "identification",
    "field",
    choices=("field", "regression", "subspace", "dmdc"),
    nodes="CT",
    group="budget and method",
).means(
    "field: a linearised model of the whole field, where its law is better; regression: least "
    "squares in reduced coordinates; subspace: a model in innovation form with its filter, from "
    "measurements alone, for the laws extended_kalman and observer (their default with few "
    "sensors); dmdc: the paper's truncated DMDc, the default of two_point"
)

LAW = Spec("law", "affine", nodes="CT", group="budget and method").means(
    "control law: a shipped or installed name, or code that the user must allow, 'file.py:Class' "
    "or 'module:Class'; with few sensors the default of model_based is extended_kalman"
)

PROBLEM = _section(
    "PT",
    Spec("problem", "burgers", file_name=True, nodes="PCTV").means(
        "name of the problem, used in messages and for result folders"
    ),
    Spec("equation", "burgers").means(
        "PDE of the plant: a shipped or installed name, or code that the user must allow, "
        "'file.py:Class' or 'module:Class'"
    ),
    Spec("plant", "").means(
        "your own plant instead of an equation: an installed name, or a class or function that the "
        "user must allow, 'file.py:Name' or 'module:Name'"
    ),
    Spec("grid", "", nodes="PCTV").means(
        "axes and components of the state as JSON, filled in by the plant; empty: one periodic axis"
    ),
    Spec("cost", [], nodes="PCTV").means(
        "the cost as packed JSON, from Python or the plant; empty: scalar weights and a constant "
        "target"
    ),
    Spec("length", 1.0, positive=True, unit="m", nodes="PTV").means(
        "length L of the periodic domain"
    ),
    Spec("n_z", 128, 1, 2**20).means(
        "size of the state, grid points times components; for an equation even and at least 8"
    ),
    Spec("n_a", 6, 1, 1024, nodes="PCT").means("number of actuators, the size of the action"),
    Spec("actuator_width", 0.15, positive=True, maximum=1).means(
        "width of one actuator as a fraction of L"
    ),
    *ACTUATORS,
    Spec("actuator_extents", [], 0.0, 1.0, nodes="T").means(
        "centres, then widths, of an equation's or plant's own actuators"
    ),
    Spec("sample_time", 0.05, positive=True, unit="s").means(
        "sampling time; the action is held over it"
    ),
    Spec("integration_time", 0.0025, positive=True, unit="s").means(
        "internal step of the integrator, of which sample_time is a whole multiple"
    ),
    Spec("horizon", 300, 1, 1_000_000, nodes="PCTV").means("steps T of an episode"),
    Spec("state_weight", 1.0, positive=True, nodes="PCTV").means("q of Q = q I in the stage cost"),
    Spec("action_weight", 1.0, positive=True, nodes="PCTV").means("r of R = r I in the stage cost"),
    Spec("divergence_bound", 1e3, positive=True, maximum=1e100).means(
        "magnitude of the field beyond which an environment has diverged"
    ),
    Spec("reduced_order", 4, 0, 1024, nodes="CT", group="budget and method").means(
        "order n_s of the reduced model, at most n_z; 0: the order that the exploratory episode "
        "suggests (one seed only)"
    ),
    IDENTIFICATION,
    LAW,
    Spec("dmdc_rank", 0, 0, 4096, nodes="CT").means(
        "rank p of [Z; Y] for the identification dmdc; 0: n_s + n_a"
    ),
    Spec("dmdc_order", 0, 0, 1024, nodes="CT").means(
        "order n_s for the identification dmdc; 0: reduced_order"
    ),
    Spec("exploration_variance", 0.0, 0.0, 1e300, nodes="T").means(
        "variance of exploratory actions, raised as measurement_noise requires, between two bounds to "
        "four times at most; of several the largest, and others in proportion to exploration_scale; 0: "
        "0.1, or the square of a quarter of half the range, less near a bound"
    ),
    Spec("exploration_mean", [], -1e300, 1e300, nodes="CT").means(
        "operating point around which actions are explored, one number for each actuator; empty: with "
        "action_bounds the cost's a_r if it is not 0, or their middle, two standard deviations inside "
        "if it is not one; without, 0"
    ),
    Spec("exploration_scale", [], 0.0, 1e300, nodes="CT").means(
        "standard deviations of exploratory actions, one for each actuator; empty: those of "
        "exploration_variance 0, and of a plant of your own in proportion to what its inputs do, "
        "where those move its state too little, too far, or less than measurement_noise"
    ),
    Spec("learning_rate", 1e-4, positive=True, nodes="T").means(
        "step size eta of two_point from the LQT warm start"
    ),
    Spec("learning_rate_from_zero", 1e-5, positive=True, nodes="T").means(
        "step size eta of two_point from zero gains"
    ),
    Spec("smoothing_radius", 0.1, positive=True, maximum=1e6, nodes="T").means(
        "radius r of the perturbation of two_point"
    ),
    *INSTRUMENTS,
)
"""Parameters of a problem's YAML file, apart from `physical.*` (those of the equation or plant)."""
POINTS = Spec("n_z", 128, 8, 65536, multiple_of=2)
"""The size of the state of an equation."""
OF_THE_PLANT = (
    "grid",
    "cost",
    "action_bounds",
    "length",
    "n_z",
    "n_a",
    "actuator_extents",
    "sample_time",
    "horizon",
    "state_weight",
    "action_weight",
    "divergence_bound",
    "reduced_order",
)
"""Parameters that a user's own plant supplies where the problem does not."""

PLANT = _section(
    "P",
    Spec("action_timeout", 0.05, 0.001, 60.0, unit="s", live=True).means(
        "time without an action after which the plant publishes its state again"
    ),
    Spec("max_repeats", 600, 1, 1_000_000, live=True).means(
        "unanswered repeats of one state after which the episode is void"
    ),
    Spec("run_hold", 10.0, 0.1, 3600.0, unit="s", live=True).means(
        "silence of a run's tuner after which another run may take over the plant"
    ),
    Spec("publish_clock", True).means(
        "publish simulated time on /clock while there is a subscriber"
    ),
    Spec("real_time_factor", 0.0, 0.0, 1e6, live=True, group="problem").means(
        "simulated seconds per second of the wall clock; 0: as fast as possible"
    ),
)

EXECUTION = _section(
    "PC",
    Spec("pin", -1, -1, 4095).means(
        "core that the node stays on, except for the plant's worker threads; -1: any core"
    ),
)
"""Use of the machine by plant and controller."""

OPTIMIZER = Spec("optimizer", "model_based", nodes="T", group="budget and method").means(
    "method of the adapt phase: a shipped or installed name, or code that the user must allow, "
    "'file.py:Class' or 'module:Class'; its settings are optimizer_settings.*"
)

TUNER = _section(
    "T",
    Spec("seed", 0, 0, MAX_SEED, group="budget and method").means(
        "seed of all random numbers of the training"
    ),
    Spec("seeds", 1, 1, 1024, group="budget and method").means(
        "number of trainings in one batch, with the seeds seed, seed + 1, ..."
    ),
    Spec("rollouts", 0, 0, 2_000_000, group="budget and method").means(
        "budget of a seed: all rollouts before the closing evaluation, including explorations and "
        f"checks; 0: {ROLLOUTS}, unless 'iterations' is given"
    ),
    Spec("iterations", 0, 0, 1_000_000, group="budget and method").means(
        "budget in iterations after exploration and check, as the paper counts (two rollouts each), "
        "instead of 'rollouts'; 0: not given"
    ),
    Spec("start", "lqt", choices=("lqt", "zero"), group="budget and method").means(
        "initial policy: the LQT gains of the reduced model, or zero"
    ),
    Spec("model", "").means(
        "file from 'pdeloop identify --out' with the reduced model and warm start of every seed, or, "
        "for 'pdeloop train', with A and B alone; empty: identify one"
    ),
    Spec("identification_attempts", 3, 1, 1000).means(
        "exploratory episodes that a seed may use until its LQT law beats no control on a sampled "
        "field; if none does, the adaptation starts from no control; 1: take the first law "
        "unchecked, as the paper does"
    ),
    Spec("evaluation_fields", 10, 1, 1000, group="budget and method").means(
        "number of initial fields drawn for the closing evaluation"
    ),
    Spec("evaluation_seed", 0, 0, MAX_SEED, group="budget and method").means(
        "seed of these fields, the same for every training seed, so that runs are comparable"
    ),
    Spec("out", "").means("folder of the results and the checkpoint; empty: keep nothing"),
    Spec("resume", False).means("continue the run whose checkpoint is in 'out'"),
    Spec("plant_fingerprint", 0, 0, 2**53 - 1).means(
        "fingerprint of the plant to train; 0: the first one that answers"
    ),
    Spec("max_batch", 1024, 1, 65536, live=True).means(
        "largest number of environments of one episode"
    ),
    Spec("episode_timeout", 600.0, 1.0, 86400.0, unit="s", live=True).means(
        "silence of a pair after which its episode is started again"
    ),
    Spec("max_attempts", 5, 1, 1000, live=True).means(
        "attempts at one episode before the run stops with an error"
    ),
    OPTIMIZER,
    Spec("recorder", "none", choices=("none", "start", "required")).means(
        "none: no recorder; start: wait for one, and continue if it stops; required: wait, and "
        "stop if it stops"
    ),
    Spec("pairs", [""], nodes="TR").means(
        "namespaces of the plant and controller pairs of this tuner, relative to its own"
    ),
)

RECORDER = _section(
    "R",
    Spec("bag", "").means("new folder for the bag; empty: bags/TIME"),
    Spec("state_every", 1, 1, 65536).means(
        "interval in steps at which an episode's states are recorded, from the first; 1: every step"
    ),
)

VIEWER = _section(
    "V",
    Spec("view_rate", 10.0, 0.1, 100.0, unit="1/s", live=True).means("views per second"),
    Spec("view_environment", 0, 0, 65535, live=True).means(
        "environment shown; in a smaller episode, the last one"
    ),
)


EVALUATION = frozenset(
    {spec.name for spec in PROBLEM if "P" in spec.nodes} - {"problem"}
    | {"evaluation_fields", "evaluation_seed"}
)
"""Parameters that, with `physical.*`, must agree for costs to be comparable."""


def table() -> tuple[Spec, ...]:
    """Every parameter of the nodes."""
    return (*PROBLEM, *PLANT, *EXECUTION, *TUNER, *RECORDER, *VIEWER)


def with_budget(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters with the default budget, if they give none."""
    given = values["rollouts"] or values["iterations"]
    return {**values, "rollouts": values["rollouts"] if given else ROLLOUTS}


def as_recorded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of a run or a bag: one that knows no identification had the only one there was."""
    old = "dmdc_rank" in values and "identification" not in values
    return with_names({**values, **({"identification": "dmdc"} if old else {})})


def with_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters by their present names: a number as `plant` was the fingerprint once."""
    plant = values.get("plant", "")
    if isinstance(plant, str):
        return dict(values)
    return {**values, "plant": "", "plant_fingerprint": plant}


def recorded_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """The checked parameters of a run or a bag, with current defaults for those that it lacks.

    Others, `physical.*` among them, are kept as they are. ParameterError where one is out of range.
    """
    given = as_recorded(values)
    return {**given, **check(table(), given)}


def model_order(values: Mapping[str, Any]) -> int:
    """n_s of the reduced model that these parameters identify; 0: as the data suggest."""
    own = values["dmdc_order"] if values["identification"] == "dmdc" else 0
    return own or values["reduced_order"]


def taken_by(node: str) -> tuple[Spec, ...]:
    """The parameters of a node, by the name of its package."""
    return tuple(spec for spec in table() if node in (NODES[letter] for letter in spec.nodes))


def flags(group: str | None = None) -> tuple[Spec, ...]:
    """The parameters that `pdeloop train` and the launch files have a flag for, in a group or all."""
    return tuple(spec for spec in table() if spec.group and group in (None, spec.group))


def measured_size(values: Mapping[str, Any]) -> int:
    """Numbers of a message `state`: those of the state, or of the last readings of sensors.

    Each sensor measures all components at its point.
    """
    if not values["sensors"]:
        return int(values["n_z"])
    # Not at the top: the help of a command waits for no NumPy.
    from pdeloop.messages.grid import Grid

    components = len(Grid.parse(values["grid"]).components) if values["grid"] else 1
    return int(values["sensors"] * values["sensor_delays"] * components)


def noisy(values: Mapping[str, Any]) -> bool:
    """True if the plant of these parameters has noise, for which a rollout then has a seed."""
    return bool(values["measurement_noise"] or values["process_noise"])
