"""The tick of a plant, and of what commands it, compiled for vector registers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from spacerobot_ros.batch.controlling import CONTROL_INPUTS, CONTROL_OUTPUTS, BatchController
from spacerobot_ros.batch.flights import Controlled, Flights
from spacerobot_ros.batch.native import Driver, vector_unit
from spacerobot_ros.model.compilation import compilation_settings
from spacerobot_ros.model.model_functions import Composition, ModelFunctions
from spacerobot_ros.parameters import values_of
from spacerobot_ros.simulation import effort_plant, velocity_plant


@dataclass(frozen=True)
class TickLayout:
    """How the tick of a plant is laid out.

    ``inputs`` and ``outputs`` are the names of the arguments and results of its function,
    ``flight`` those results that every tick needs, ``copies`` what a tick hands to the next.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    flight: tuple[str, ...]
    copies: Mapping[str, str]

    @property
    def reported(self) -> tuple[str, ...]:
        """Results that reports need too: all but the poses of links."""
        return tuple(name for name in self.outputs if not name.startswith("link"))


_LAYOUTS = {
    "velocity": TickLayout(
        ("state", "command", "momenta", "r_cm", "h"),
        (
            *("next_state", "pose", "twist", "qdot", "momentum"),
            *("link_R", "link_r", "limited", "next_r_cm"),
        ),
        ("next_state", "qdot", "limited", "next_r_cm"),
        {"next_state": "state", "next_r_cm": "r_cm"},
    ),
    "effort": TickLayout(
        ("state", "command", "h"),
        (
            *("next_state", "pose", "twist", "realised"),
            *("momentum", "link_R", "link_r", "limited"),
        ),
        ("next_state", "realised", "limited"),
        {"next_state": "state"},
    ),
}


@dataclass(frozen=True)
class CompiledTick:
    """The compiled tick of flights that are alike, and where its numbers stand in rows.

    Attributes
    ----------
    driver
        The loop.
    layout
        Of its arguments and results.
    sizes
        Rows of each name.
    controller
        What commands; None: tables.
    """

    driver: Driver
    layout: TickLayout
    sizes: Mapping[str, int]
    controller: BatchController | None = None

    @classmethod
    def of(cls, flights: Flights, model: ModelFunctions) -> CompiledTick:
        """Compile the tick of flights, or find it compiled.

        Raises
        ------
        NoLibraryError
            It cannot be compiled here.
        ParameterError
            The law cannot drive what is to be controlled, or is none for lanes.
        """
        key: tuple[Any, ...] = (
            *(cls, flights.actuation, flights.substeps, vector_unit(), compilation_settings()),
        )
        program = flights.program
        if isinstance(program, Controlled):
            # All but the gains, which flights have of their own, is part of the function.
            given = values_of(program.config).items()
            parameters = [each for each in given if not each[0].startswith("gains.")]
            believed = program.robot or flights.robot
            key = (*key, believed, repr(parameters), repr(program.config.motion))
            key = (*key, _count(flights))
        if key not in model.derived:
            model.derived[key] = cls._new(flights, model)
        found: CompiledTick = model.derived[key]
        if found.controller is not None and isinstance(program, Controlled):
            return replace(found, controller=found.controller.serving(program))
        return found

    @classmethod
    def _new(cls, flights: Flights, model: ModelFunctions) -> CompiledTick:
        layout, robot = _LAYOUTS[flights.actuation], flights.robot
        make = {"velocity": velocity_plant, "effort": effort_plant}[flights.actuation].tick_function
        whole = make(robot, Composition(model, ca.MX), flights.substeps)
        inputs = whole.mx_in()
        outputs = dict(zip(layout.outputs, whole.call(inputs, True, False), strict=True))
        flight, report = (
            ca.Function(f"{flights.actuation}_{name}", inputs, [outputs[each] for each in chosen])
            for name, chosen in (("flight", layout.flight), ("report", layout.reported))
        )
        sizes = {
            **{n: whole.nnz_in(i) for i, n in enumerate((*layout.inputs, "p"))},
            **{n: whole.nnz_out(i) for i, n in enumerate(layout.outputs)},
        }
        if not isinstance(flights.program, Controlled):
            return cls(Driver(flight, report), layout, sizes)
        controller = BatchController.of(flights)
        control = controller.function()
        sizes |= {name: control.nnz_in(i) for i, name in enumerate(CONTROL_INPUTS)}
        sizes |= {name: control.nnz_out(i) for i, name in enumerate(CONTROL_OUTPUTS)}
        driver = Driver(flight, report, control, _count(flights))
        return cls(driver, layout, sizes, controller)


def _count(flights: Flights) -> int:
    return 0 if flights.thrusters is None else len(flights.thrusters.names)
