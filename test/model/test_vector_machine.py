"""Functions at many places in vector registers give the numbers of CasADi's virtual machine."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.model import vector_machine
from spacerobot_ros.model.compilation import c_compiler
from spacerobot_ros.model.vector_machine import mapped

needs_compiler = pytest.mark.skipif(c_compiler() is None, reason="needs a C compiler")


def rows_of(x: ca.SX, p: ca.SX) -> ca.SX:
    """Return rows with every operation that the models use, and some more."""
    a, b, c, d = ca.vertsplit(x)
    rows = [a + b, a - c, b * d, c / d, -a, a**2, 2 * b, 1 / c, ca.sqrt(ca.fabs(d)), ca.sin(a)]
    rows += [ca.cos(b), ca.tan(c), ca.asin(a / 9), ca.acos(b / 9), ca.atan(c), ca.atan2(a, d)]
    rows += [ca.exp(a), ca.log(ca.fabs(d)), ca.tanh(a), ca.floor(b), ca.ceil(c), ca.sign(d)]
    rows += [ca.fmin(a, b), ca.fmax(c, d), ca.if_else(a < b, c, d), ca.if_else(a <= b, p, d)]
    rows += [ca.if_else(a == b, c, d), ca.if_else(a != b, c, d), ca.copysign(a, b)]
    rows += [ca.logic_and(a, b), ca.logic_or(a, b), ca.logic_not(c), ca.constpow(d, 2.5) * p]
    return ca.vertcat(*rows, ca.SX(1, 1), ca.fabs(a) ** b)


@needs_compiler
@pytest.mark.parametrize("count", [2, 4, 7, 8, 9, 15, 20, 37, 71])
def test_the_numbers_are_those_of_the_virtual_machine(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    x, p = ca.SX.sym("x", 4), ca.SX.sym("p")
    rows = rows_of(x, p)
    function = ca.Function("rows", [x, p], [rows, ca.jacobian(rows, x)])
    rng = np.random.default_rng(29)
    values = rng.normal(size=(4, count)) * 3
    values[:, 1] = [0.0, -0.0, np.inf, np.nan]
    at_all = mapped(function, count)
    assert isinstance(at_all, vector_machine._MappedFunction)
    given = [ca.DM(values), ca.DM(rng.normal(size=(1, count)))]
    for here, there in zip(at_all.call(given), function.map(count).call(given), strict=True):
        assert here.sparsity() == there.sparsity()
        np.testing.assert_array_equal(here.nonzeros(), there.nonzeros())


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("unit", [*vector_machine.VECTOR_UNITS, "plain"])
def test_narrower_registers_give_the_same_numbers(
    unit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    units = {**vector_machine.VECTOR_UNITS, "plain": vector_machine._PORTABLE_UNIT}
    chosen = units[unit]
    if chosen.lanes > vector_machine.vector_unit().lanes:
        pytest.skip(f"this processor has no {chosen.name}")
    monkeypatch.setattr(vector_machine, "vector_unit", lambda: chosen)
    x, p = ca.SX.sym("x", 4), ca.SX.sym("p")
    function = ca.Function("rows", [x, p], [rows_of(x, p)])
    rng = np.random.default_rng(30)
    given = [ca.DM(3 * rng.normal(size=(4, 21))), ca.DM(rng.normal(size=(1, 21)))]
    at_all = mapped(function, 21)
    assert isinstance(at_all, vector_machine._MappedFunction)
    (here,), (there,) = at_all.call(given), function.map(21).call(given)
    np.testing.assert_array_equal(here.nonzeros(), there.nonzeros())


def test_without_a_compiler_the_virtual_machine_takes_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    x = ca.SX.sym("x")
    function = ca.Function("square", [x], [x**2])
    assert mapped(function, 3)(ca.DM([[1.0, 2.0, 3.0]])).nonzeros() == [1.0, 4.0, 9.0]


def test_functions_that_have_other_operations_are_run_by_casadi() -> None:
    x = ca.SX.sym("x")
    function = ca.Function("hyperbolic", [x], [ca.sinh(x)])
    assert not isinstance(mapped(function, 2), vector_machine._MappedFunction)


@needs_compiler
def test_arguments_and_results_may_be_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """CasADi gives no memory for zeros, nor for results that nobody asks for."""
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    x, p, none = ca.SX.sym("x", 2), ca.SX.sym("p", 2), ca.SX.sym("none", 0)
    function = ca.Function("rows", [x, p, none], [x * p, x + p + 1])
    at_all = mapped(function, 5)
    assert isinstance(at_all, vector_machine._MappedFunction)
    given = ca.MX.sym("given", 2, 5)
    _, sums = at_all(given, 0, ca.MX(0, 5))
    values = np.arange(10.0).reshape(2, 5)
    only = ca.Function("only", [given], [sums])
    np.testing.assert_array_equal(only(values).full(), values + 1)
    # Numbers of one call do not stay for the next one.
    product, _ = at_all(given, ca.DM(values), ca.MX(0, 5))
    both = ca.Function("both", [given], [product, sums])
    for of_product, of_sums in (both(values), both(values)):
        np.testing.assert_array_equal(of_product.full(), values**2)
        np.testing.assert_array_equal(of_sums.full(), values + 1)
