# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant of a user's own from a problem's parameters: by its name, or the object of a Python program.

Which code may be run: `pdeloop.messages.own_code`.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from pde_sim_node.definition import described
from pde_sim_node.dynamics import Dynamics, arguments_of, signature_of
from pde_sim_node.plant import Plant
from pde_sim_node.plants import fmu, process
from pde_sim_node.plants.boundary import ReactionDiffusionBoundary, Transport
from pde_sim_node.plants.cavity import Cavity
from pde_sim_node.plants.convection import Convection
from pde_sim_node.plants.convection_layer import ConvectionLayer
from pde_sim_node.plants.falling_film import FallingFilm
from pde_sim_node.plants.interval import Interval
from pde_sim_node.plants.kuramoto_sivashinsky_eight import KuramotoSivashinskyEight
from pde_sim_node.plants.kuramoto_sivashinsky_four import KuramotoSivashinskyFour
from pde_sim_node.plants.reactions import (
    Brusselator,
    ComplexGinzburgLandau,
    FitzHughNagumo,
    GrayScott,
    Plate,
)
from pde_sim_node.plants.stateful_plant import plant_of
from pde_sim_node.plants.vorticity import Kolmogorov
from pdeloop.messages.own_code import FAILURES, FMU, PROCESS, OwnCode, located, name_of
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.text import shown

PLANTS: Mapping[str, type[Dynamics]] = MappingProxyType(
    {
        "interval": Interval,
        "cavity": Cavity,
        "convection": Convection,
        "convection-layer": ConvectionLayer,
        "kolmogorov": Kolmogorov,
        "transport": Transport,
        "reaction-diffusion": ReactionDiffusionBoundary,
        "kuramoto-sivashinsky-eight": KuramotoSivashinskyEight,
        "kuramoto-sivashinsky-four": KuramotoSivashinskyFour,
        "falling-film": FallingFilm,
        "plate": Plate,
        "gray-scott": GrayScott,
        "brusselator": Brusselator,
        "fitzhugh-nagumo": FitzHughNagumo,
        "complex-ginzburg-landau": ComplexGinzburgLandau,
    }
)
"""Those that are shipped, by name."""
OWN_PLANTS = OwnCode("plant", "PDELOOP_PLANTS", PLANTS, {FMU: fmu.maker, PROCESS: process.maker})
OBJECT = "object of a Python program:"
"""The prefix of parameters that no file can hold."""
PHYSICAL = "physical."


class Made(NamedTuple):
    """A plant, and the parameters with which it was made, by name."""

    plant: Dynamics | Plant
    parameters: Mapping[str, Any]


_objects: dict[str, Made] = {}
"""Objects that were handed over in this process, by their names and parameters."""


def physical_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters `physical.NAME`, by NAME."""
    return {
        name.removeprefix(PHYSICAL): value
        for name, value in values.items()
        if name.startswith(PHYSICAL)
    }


def make(values: Mapping[str, Any]) -> Made:
    """Make the object that the parameter `plant` names, with `physical.*`.

    Raises
    ------
    ValueError
        It is code that is not allowed, or cannot be loaded, or made with these parameters.
    """
    name, physical = str(values["plant"]), physical_of(values)
    known = _objects.get(_key(name, physical))
    if known is not None:
        return known
    for own, value in physical.items():
        if isinstance(value, str) and value.startswith(OBJECT):
            raise ParameterError(
                f"parameter '{PHYSICAL}{own}' of {name} was an object of the Python program that "
                "made the plant; such a plant can be used in that program alone"
            )
    maker = OWN_PLANTS.configured(name)
    if not callable(maker):
        raise ValueError(f"plant {shown(name)} must be a class or a function, got {maker!r}")
    arguments = fitting(maker, physical, name)
    try:
        made = maker(**arguments)
    except FAILURES as error:
        argument = isinstance(error, ValueError) and OWN_PLANTS.whole(name) is not None
        told = str(error) if argument else located(error)
        raise ValueError(f"the plant {shown(name)} cannot be made: {told}") from error
    if not isinstance(made, Dynamics | Plant):
        raise ValueError(
            f"plant {shown(name)} must be a class derived from pdeloop.Dynamics, or make one of its "
            f"objects, got {shown(made)}"
        )
    require_complete(made)
    defaults = signature_of(maker).parameters.values()
    stored = {p.name: p.default for p in defaults if _storable(p.default)}
    return Made(made, stored | arguments)


def fitting(maker: Callable[..., Any], given: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The arguments to make it with: whole numbers become floats where the default is a float.

    ParameterError for one that it does not take, and where one is missing.
    """
    signature = signature_of(maker)
    known = signature.parameters
    any_name = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in known.values())
    arguments = dict(given)
    for own, value in given.items():
        if own not in known and not any_name:
            names = ", ".join(known) or "none"
            raise ParameterError(f"unknown parameter '{PHYSICAL}{own}' of {name}; known: {names}")
        default = known[own].default if own in known else None
        if isinstance(default, float) and type(value) is int:
            arguments[own] = float(value)
        elif type(default) is int and isinstance(value, float) and value.is_integer():
            arguments[own] = int(value)
    try:
        signature.bind(**arguments)
    except TypeError as error:
        raise ParameterError(
            f"the plant {shown(name)} cannot be made: {error}; give it as '{PHYSICAL}NAME'"
        ) from error
    return arguments


def hand_over(plant: Dynamics | Plant) -> dict[str, Any]:
    """The parameters that name an object of this program: for it, and where it can be made again.

    Its code is allowed here and in the processes that are started.
    """
    require_complete(plant)
    kind = type(plant)
    arguments = dict(arguments_of(plant)) if isinstance(plant, Dynamics) else {}
    own = ""
    if isinstance(plant, fmu.Fmu):
        own = arguments.pop("path")
    elif isinstance(plant, process.Process):
        own = f"{PROCESS}{arguments.pop('command')}"
    stored = {
        name: described(name, value) if _storable(value) else f"{OBJECT} {described(name, value)}"
        for name, value in arguments.items()
        if _storable(value) or not _is_default(kind, name, value)
    }
    if not isinstance(plant, Dynamics):  # its arguments are unknown
        stored = {"plant": f"{OBJECT} {plant.definition.fingerprint}"}
    name = OWN_PLANTS.allow(own or name_of(kind))
    _objects[_key(name, stored)] = Made(plant, stored)
    return {"plant": name} | {f"{PHYSICAL}{own}": value for own, value in stored.items()}


def as_plant(plant: object) -> Plant:
    """A plant as the loop needs it, from one or from a `Dynamics`; ValueError for anything else."""
    if isinstance(plant, Dynamics):
        return plant_of(plant)
    if not isinstance(plant, Plant):
        raise ValueError(
            f"plant is {shown(plant)}; expected a Plant, or an object of a class derived from "
            "Dynamics"
        )
    require_complete(plant)
    return plant


def require_complete(plant: Dynamics | Plant) -> None:
    """ValueError for a class derived from `Plant` itself that leaves out a part of that interface."""
    if isinstance(plant, Dynamics):
        return
    kind = type(plant)
    left = [name for name in Plant.__annotations__ if not hasattr(plant, name)]
    left += [
        name
        for name, member in vars(Plant).items()
        if not name.startswith("_") and getattr(kind, name, None) is member
    ]
    if left:
        raise ValueError(
            f"{kind.__name__} is derived from pdeloop.Plant, the interface of many environments at "
            f"once, and lacks {len(left)} parts of it, such as {left[0]}; derive "
            "it from pdeloop.Dynamics, which needs sizes, initial_state and step"
        )


def _storable(value: object) -> bool:
    """True if a YAML file and ROS parameters can hold it."""
    if isinstance(value, list):
        return bool(value) and len({type(item) for item in value}) == 1 and _storable(value[0])
    return isinstance(value, bool | int | float | str | np.number)


def _is_default(kind: type, name: str, value: object) -> bool:
    known = signature_of(kind).parameters
    return name in known and known[name].default is value


def _key(name: str, physical: Mapping[str, Any]) -> str:
    return json.dumps([name, dict(physical)], sort_keys=True)
