"""Counts how often the data-dependent loops of an accelerator's program turn, by running it on the CPU.

The program is traced for an accelerator, and each of its loops is given a counter: equations are evaluated
one by one, as JAX would, but for loops and the calls that hold them.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core

from benchmarks.hlo_text import Frame
from benchmarks.launch_model import Turns
from benchmarks.xla_dump import key_of
from jaxbox import DetectorConfig, PointCloud, detector
from jaxbox.run import compiled
from jaxbox.xla.backend import building_for

CALLS = ("jit", "pjit", "closed_call")
"""Calls of functions whose equations are counted as if they stood in the caller."""

Tally = dict[str, jax.Array]
"""(2,) int32 by the key of a loop: its turns and its calls."""


def turns_of_sweeps(
    clouds: Sequence[PointCloud], config: DetectorConfig, *, together: bool
) -> dict[str, Turns]:
    """Turns and calls of each data-dependent loop.

    Args:
      clouds: sweeps of one capacity.
      config: the settings.
      together: for a batch of them, where a loop turns as long as it does for any; else the mean.

    Returns:
      Them, by what `xla_dump.key_of` tells loops by.
    """
    if not clouds:
        return {}
    with building_for(accelerator=True):
        operands = [compiled._operands(cloud, config, None) for cloud in clouds]
    program = jax.make_jaxpr(compiled._find_vehicles)(*operands[0])
    run = jax.jit(lambda *values: evaluate(program.jaxpr, program.consts, values, no_turns(program.jaxpr))[1])
    tallies = [jax.device_get(run(*jax.tree.leaves(sweep))) for sweep in operands]
    return {key: _merge([tally[key] for tally in tallies], together) for key in tallies[0]}


def _merge(tallies: Sequence[Any], together: bool) -> Turns:
    turns, calls = zip(*tallies, strict=True)
    if together:
        return Turns(float(max(turns)), float(max(calls)))
    return Turns(float(sum(turns)) / len(tallies), float(sum(calls)) / len(tallies))


def evaluate(
    jaxpr: core.Jaxpr, consts: Sequence[Any], values: Sequence[Any], tally: Tally
) -> tuple[list[Any], Tally]:
    """Evaluates the equations of a function and counts the turns of its loops.

    Args:
      jaxpr: the function.
      consts: its constants.
      values: its arguments.
      tally: turns so far; has an entry for each loop, see `no_turns`.

    Returns:
      The function's results, and the turns with its own added.
    """
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *values], strict=True))

    def look_up(atom: Any) -> Any:
        return atom.val if isinstance(atom, core.Literal) else known[atom]

    for equation in jaxpr.eqns:
        given = [look_up(atom) for atom in equation.invars]
        if equation.primitive.name == "while":
            results, tally = _run_loop(equation, given, tally)
        elif equation.primitive.name in CALLS:
            called = _called(equation)
            results, tally = evaluate(called.jaxpr, called.consts, given, tally)
        else:
            results = _evaluate_alone(jaxpr, equation, given)
        known.update(zip(equation.outvars, results, strict=True))
    return [look_up(atom) for atom in jaxpr.outvars], tally


def _evaluate_alone(jaxpr: core.Jaxpr, equation: Any, given: Sequence[Any]) -> list[Any]:
    """Results of one equation, as a function of its own: JAX's releases bind them in different ways."""
    values = {
        atom: value
        for atom, value in zip(equation.invars, given, strict=True)
        if not isinstance(atom, core.Literal)
    }
    # One name for each argument and result, as JAX checks.
    names = {"arg_names": ("",) * len(values), "result_paths": ("",) * len(equation.outvars)}
    named = jaxpr.debug_info._replace(**names)
    alone = core.Jaxpr([], list(values), equation.outvars, [equation], debug_info=named)
    return core.jaxpr_as_fun(core.ClosedJaxpr(alone, []))(*values.values())


def _run_loop(loop: Any, given: Sequence[Any], tally: Tally) -> tuple[list[Any], Tally]:
    more, body = loop.params["cond_jaxpr"], loop.params["body_jaxpr"]
    split = loop.params["cond_nconsts"], loop.params["cond_nconsts"] + loop.params["body_nconsts"]
    for_more, for_body, start = given[: split[0]], given[split[0] : split[1]], given[split[1] :]
    key = key_of(frames_of(loop))

    def has_more(state: tuple[list[Any], Tally]) -> Any:
        return evaluate(more.jaxpr, more.consts, [*for_more, *state[0]], state[1])[0][0]

    def turn(state: tuple[list[Any], Tally]) -> tuple[list[Any], Tally]:
        values, tally = evaluate(body.jaxpr, body.consts, [*for_body, *state[0]], state[1])
        return values, tally | {key: tally[key] + jnp.array([1, 0])}

    tally = tally | {key: tally[key] + jnp.array([0, 1])}
    return jax.lax.while_loop(has_more, turn, (list(start), tally))


def no_turns(jaxpr: core.Jaxpr) -> Tally:
    """A tally of all loops in a function, at any depth; ends the program where one cannot be counted."""
    tally: Tally = {}
    for equation in jaxpr.eqns:
        inner = [no_turns(part) for value in equation.params.values() for part in _functions_in(value)]
        found = {key: count for part in inner for key, count in part.items()}
        if equation.primitive.name == "while":
            found[key_of(frames_of(equation))] = jnp.zeros(2, jnp.int32)
        elif found and equation.primitive.name not in CALLS:
            raise SystemExit(f"loops within {equation.primitive.name} are not counted: {', '.join(found)}")
        tally |= found
    return tally


def _called(call: Any) -> core.ClosedJaxpr:
    return next(value for value in call.params.values() if isinstance(value, core.ClosedJaxpr))


def _functions_in(value: Any) -> list[core.Jaxpr]:
    """The functions that a parameter of an equation holds."""
    if isinstance(value, core.ClosedJaxpr):
        return [value.jaxpr]
    if isinstance(value, core.Jaxpr):
        return [value]
    return [part for one in value for part in _functions_in(one)] if isinstance(value, tuple | list) else []


def frames_of(equation: Any) -> list[Frame]:
    """Lines of jaxbox that an equation stems from, innermost first: the others are JAX's or the caller's."""
    root = detector.__file__.removesuffix("detector.py")
    traceback = equation.source_info.traceback
    return [
        Frame(frame.file_name, frame.line_num, frame.function_name)
        for frame in (traceback.frames if traceback else [])
        if frame.file_name.startswith(root)
    ]
