"""Transcription against tables of Runge–Kutta coefficients, a plain loop, finite differences and casadi's own derivatives."""

from dataclasses import replace
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
import pytest
from phases import changed
from scipy.interpolate import BPoly, CubicSpline

from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Boundary, Bounded, Cycle, Guess, Link, Phase, PhaseGuess, Problem
from rrr_oc.optimal_control.refinement import mesh_error
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Solver, solve
from rrr_oc.optimal_control.transcription import Transcription

R3, R5, R6 = np.sqrt([3, 5, 6])
# Hairer & Wanner, "Solving Ordinary Differential Equations II", tables IV.5.1, 5.6 and 5.7 (Lobatto IIIA), in (A, c); b follows
TABLES = {
    ("hermite-simpson", 3): (
        [[0, 0, 0], [5 / 24, 1 / 3, -1 / 24], [1 / 6, 2 / 3, 1 / 6]],
        [0, 1 / 2, 1],
        [1 / 6, 2 / 3, 1 / 6],
    ),
    ("lobatto", 2): ([[0, 0], [1 / 2, 1 / 2]], [0, 1], [1 / 2, 1 / 2]),
    ("lobatto", 3): ([[0, 0, 0], [5 / 24, 1 / 3, -1 / 24], [1 / 6, 2 / 3, 1 / 6]], [0, 1 / 2, 1], [1 / 6, 2 / 3, 1 / 6]),
    ("lobatto", 4): (
        np.array(
            [
                [0, 0, 0, 0],
                [11 + R5, 25 - R5, 25 - 13 * R5, -1 + R5],
                [11 - R5, 25 + 13 * R5, 25 + R5, -1 - R5],
                [10, 50, 50, 10],
            ]
        )
        / 120,
        [0, (5 - R5) / 10, (5 + R5) / 10, 1],
        [1 / 12, 5 / 12, 5 / 12, 1 / 12],
    ),
    ("gauss", 1): ([[1 / 2]], [1 / 2], [1]),
    ("gauss", 2): ([[1 / 4, 1 / 4 - R3 / 6], [1 / 4 + R3 / 6, 1 / 4]], [1 / 2 - R3 / 6, 1 / 2 + R3 / 6], [1 / 2, 1 / 2]),
    ("radau", 1): ([[1]], [1], [1]),
    ("radau", 2): ([[5 / 12, -1 / 12], [3 / 4, 1 / 4]], [1 / 3, 1], [3 / 4, 1 / 4]),
    ("radau", 3): (
        [
            [(88 - 7 * R6) / 360, (296 - 169 * R6) / 1800, (-2 + 3 * R6) / 225],
            [(296 + 169 * R6) / 1800, (88 + 7 * R6) / 360, (-2 - 3 * R6) / 225],
            [(16 - R6) / 36, (16 + R6) / 36, 1 / 9],
        ],
        [(4 - R6) / 10, (4 + R6) / 10, 1],
        [(16 - R6) / 36, (16 + R6) / 36, 1 / 9],
    ),
}
SCHEMES = [scheme("hermite-simpson"), scheme("lobatto", 2), scheme("lobatto", 4), scheme("gauss", 1), scheme("gauss", 3)]
SCHEMES += [scheme("radau", 1), scheme("radau", 2), scheme("radau", 3)]
EVERYWHERE = [scheme("lobatto", 4, everywhere=True), scheme("gauss", 3, everywhere=True)]
each_scheme = pytest.mark.parametrize(
    "method", [*SCHEMES, *EVERYWHERE], ids=lambda s: f"{s.name}-{s.d}{'-everywhere' * s.everywhere}"
)


@pytest.mark.parametrize("key", TABLES, ids=lambda k: f"{k[0]}-{k[1]}")
def test_coefficients_are_those_of_the_tables(key):
    for found, known in zip((scheme(*key).A, scheme(*key).c, scheme(*key).b), TABLES[key], strict=True):
        np.testing.assert_allclose(found, known, atol=1e-14)  # rounding of a small Vandermonde system


@pytest.mark.parametrize(("name", "stages"), [*product(("lobatto", "gauss", "radau"), range(2, 10)), ("hermite-simpson", 3)])
def test_order_conditions(name, stages):
    """B(p), and not B(p + 1); C(d): Σ_j A_ij c_j^(k−1) = c_i^k / k. For collocation methods B(p) makes the order p."""
    s = scheme(name, stages)
    for k in range(1, s.order + 1):
        assert s.b @ s.c ** (k - 1) == pytest.approx(1 / k, abs=1e-11)  # nine stages lose four digits in the Vandermonde system
    if stages < 7:  # from there on the order's error constant drowns in rounding
        assert abs(s.b @ s.c**s.order - 1 / (s.order + 1)) > 1e-11
    for k in range(1, s.d + 1):
        np.testing.assert_allclose(s.A @ s.c ** (k - 1), s.c**k / k, atol=1e-11)


@each_scheme
def test_interpolation_weights(method):
    """Lagrange weights are the identity at the stages and reproduce polynomials; their integrals are A at stages and b at 1."""
    lagrange, integrals = method.at(method.c)
    np.testing.assert_allclose(lagrange, np.eye(method.d), atol=1e-13)
    np.testing.assert_allclose(integrals, method.A, atol=1e-13)
    np.testing.assert_allclose(method.at(np.ones(1))[1][0], method.b, atol=1e-13)
    s = np.linspace(0, 1, 7)
    lagrange, integrals = method.at(s)
    np.testing.assert_allclose(lagrange @ method.c ** (method.d - 1), s ** (method.d - 1), atol=1e-13)
    np.testing.assert_allclose(integrals @ method.c ** (method.d - 1), s**method.d / method.d, atol=1e-13)


@pytest.mark.parametrize(
    ("name", "stages", "message"),
    [
        ("euler", 2, "unknown collocation scheme 'euler'.*gauss"),
        ("lobatto", 1, "2 … 9"),
        ("gauss", 0, "1 … 9"),
        ("radau", 10, "1 … 9"),
    ],
)
def test_unknown_schemes(name, stages, message):
    with pytest.raises(UserError, match=message):
        scheme(name, stages)


def phase(name: str, nx: int, nu: int, ng: int, seed: int, **changes) -> Phase:
    """A nonlinear phase in which everything depends on everything."""
    mix = np.random.default_rng(seed).normal(size=(3, nx + 1 + ng, nx + nu + 3))
    x, u, p, d = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("p", 2), ca.SX.sym("d", 1)
    a, b, c = (ca.DM(m) @ ca.vertcat(x, u, p, d) for m in mix)
    y = ca.sin(a) + 0.3 * b * c + 0.1 * b**3

    def named(kind: str, count: int) -> tuple[str, ...]:
        return tuple(f"{name} {kind}{i}" for i in range(count))

    values: dict[str, Any] = {
        "name": name,
        "rates": ca.Function("rates", [x, u, p, d], [y[:nx], y[nx], y[nx + 1 :]]),
        "x": Bounded(named("x", nx), np.full(nx, -3.0), np.full(nx, 4.0), np.linspace(0.5, 2.0, nx)),
        "u": Bounded(named("u", nu), np.full(nu, -5.0), np.full(nu, 6.0), np.linspace(3.0, 4.0, nu)),
        "path": Bounded(named("g", ng), np.full(ng, -1.0), np.linspace(1.0, 2.0, ng), np.ones(ng)),
        "start": np.r_[0.5, np.full(nx - 1, np.nan)],
        "end": np.r_[np.full(nx - 1, np.nan), -0.5],
        "duration": (0.5, 2.0),
    }
    return changed(Phase(**values), **changes)


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Two phases of different sizes and scales with three links, two parameters, one datum, three design inequalities (one of them
    linear)."""
    p, d = ca.SX.sym("p", 2), ca.SX.sym("d", 1)
    design = ca.Function("design", [p, d], [ca.vertcat(p[0] * p[1] ** 2 - d, ca.exp(p[0]) - 3, p[0] - p[1])])
    return Problem(
        phases=(phase("go", 2, 1, 1, 0), phase("back", 3, 2, 2, 1)),
        parameters=("stiffness", "length"),
        p_lower=np.array([-1.0, -2.0]),
        p_upper=np.array([3.0, 4.0]),
        p_scale=np.array([0.7, 2.5]),
        data=np.array([0.9]),
        design=design,
        designs=("product", "growth", "difference"),
        cost_scale=7.0,
        links=(Link(0, 1, (0, 1)), Link(1, 0, (1,))),
        cycles=(Cycle((0, 1), (1.2, 2.9)), Cycle((1,), (0.1, 9.0))),
    )


MESH = (np.array([0.2, 0.5, 0.3]), np.array([0.6, 0.4]))


def basis(method) -> np.ndarray:
    """Stage values themselves, or Bernstein's polynomials at the stages by scipy."""
    d = method.d
    if not method.everywhere:
        return np.eye(d)
    return np.column_stack([BPoly(np.eye(d)[k][:, None], [0, 1])(method.c) for k in range(d)])


def point(t: Transcription, seed: int = 5):
    """Random scaled variables (durations near 1), datum and multipliers."""
    rng = np.random.default_rng(seed)
    w = 0.4 * rng.normal(size=t.size)
    w[[block.duration for block in t.blocks]] = rng.uniform(0.8, 1.4, len(t.blocks))
    return w, np.array([0.9]), 1.3, rng.normal(size=t.row_bounds[0].size)


@each_scheme
def test_program_is_what_a_plain_loop_says(problem, method):
    """Cost and rows, an interval and a stage at a time, from the definition of a Runge–Kutta method."""
    t = Transcription(problem, method, MESH)
    w, d, _, _ = point(t)
    value, cost, rows = w * t.scale, 0.0, []
    p = value[:2]
    for ph, block, fractions in zip(problem.phases, t.blocks, MESH, strict=True):
        T, controls = value[block.duration], np.einsum("dk,ukn->udn", basis(method), value[block.controls])
        for n, fraction in enumerate(fractions):
            h = T * fraction
            x0, x1 = value[block.nodes[:, n]], value[block.nodes[:, n + 1]]
            X = [value[block.stage_x[:, i, n]] for i in range(method.d)]
            rates = [[np.array(o).ravel() for o in ph.rates(x, controls[:, i, n], p, d)] for i, x in enumerate(X)]
            cost += h * sum(b * r[1][0] for b, r in zip(method.b, rates, strict=True))
            for i, x in enumerate(X):
                if method.c[i] == 0:
                    np.testing.assert_array_equal(x, x0)
                    continue
                rows.append((x - x0 - h * sum(a * r[0] for a, r in zip(method.A[i], rates, strict=True))) / ph.x.scale)
                assert method.c[i] < 1 or np.array_equal(x, x1)
            if method.c[-1] < 1:
                rows.append((x1 - x0 - h * sum(b * r[0] for b, r in zip(method.b, rates, strict=True))) / ph.x.scale)
            rows += [r[2] for r in rates]
    rows.append(np.array([p[0] * p[1] ** 2 - 0.9, np.exp(p[0]) - 3, p[0] - p[1]]))
    go, back = (value[block.nodes] for block in t.blocks)
    rows += [
        (go[:2, -1] - back[:2, 0]) / problem.phases[0].x.scale,
        (back[1:2, -1] - go[1:2, 0]) / problem.phases[1].x.scale[1:2],
    ]
    of_go, of_back = (value[block.duration] for block in t.blocks)
    rows.append(np.array([of_go + of_back, of_back]))
    f, g = t.functions["nlp"](w, d)
    assert float(f) == pytest.approx(cost / problem.cost_scale, rel=1e-12)  # rounding of some hundred additions
    np.testing.assert_allclose(np.array(g).ravel(), np.concatenate(rows), atol=1e-12)
    assert len(t.row_bounds[0]) == g.numel()
    np.testing.assert_array_equal(np.array(t.row_bounds)[:, -2:], [[1.2, 0.1], [2.9, 9.0]])
    assert t.row_name(g.numel() - 2) == "duration of go and back"


@each_scheme
def test_derivatives_are_casadis_own(problem, method):
    t = Transcription(problem, method, MESH)
    w, d, lam_f, lam_g = point(t)
    functions = t.functions
    W, D, L = ca.MX.sym("w", t.size), ca.MX.sym("d", 1), ca.MX.sym("l", lam_g.size)
    f, g = functions["nlp"](W, D)
    lagrangian = lam_f * f + ca.dot(L, g)
    own = ca.Function("own", [W, D, L], [ca.gradient(f, W), ca.jacobian(g, W), ca.triu(ca.hessian(lagrangian, W)[0])])
    gradient, jacobian, hessian = own(w, d, lam_g)
    exact = dict[str, Any](rtol=1e-11, atol=1e-11)  # the same sums in another order
    np.testing.assert_allclose(np.array(functions["grad_f"](w, d)[1]), np.array(gradient), **exact)
    np.testing.assert_allclose(np.array(functions["jac_g"](w, d)[1]), np.array(jacobian), **exact)
    np.testing.assert_allclose(np.array(functions["hess_lag"](w, d, lam_f, lam_g)), np.array(hessian), **exact)
    assert functions["grad_f"].sparsity_out(1).is_dense()  # IPOPT's interface reads it as such
    for name in ("grad_f", "jac_g"):  # the values that come with them
        value = functions[name](w, d)[0]
        np.testing.assert_array_equal(np.array(value), np.array(functions["nlp"](w, d)[0 if name == "grad_f" else 1]))


@pytest.mark.parametrize("method", [scheme("lobatto", 4), scheme("radau", 2)], ids=lambda s: s.name)
def test_compiled_is_the_same(problem, method):
    """gcc at -O1 evaluates in casadi's order; other compilers may fuse multiplications and additions."""
    t = Transcription(problem, method, MESH)
    w, d, lam_f, lam_g = point(t)
    compiled = replace(t, compiled=True).functions
    for name, function in t.functions.items():
        arguments = (w, d, lam_f, lam_g) if name == "hess_lag" else (w, d)
        for plain, fast in zip(function.call(list(arguments)), compiled[name].call(list(arguments)), strict=True):
            np.testing.assert_allclose(np.array(fast), np.array(plain), rtol=1e-13, atol=1e-13)


@each_scheme
def test_derivatives_against_finite_differences(problem, method):
    t = Transcription(problem, method, MESH)
    w, d, lam_f, lam_g = point(t, 8)
    functions, step = t.functions, 1e-5

    def central(function) -> np.ndarray:
        columns = [(function(w + e) - function(w - e)) / (2 * step) for e in step * np.eye(t.size)]
        return np.column_stack(columns)

    def slope(v):
        gradient, jacobian = (np.array(functions[n](v, d)[1]) for n in ("grad_f", "jac_g"))
        return lam_f * gradient.ravel() + jacobian.T @ lam_g

    rough = dict[str, Any](rtol=1e-7, atol=1e-7)  # step² of truncation and 1e-16/step of rounding
    gradient = central(lambda v: np.array(functions["nlp"](v, d)[0]).ravel())
    np.testing.assert_allclose(np.array(functions["grad_f"](w, d)[1]).ravel(), gradient.ravel(), **rough)
    jacobian = central(lambda v: np.array(functions["nlp"](v, d)[1]).ravel())
    np.testing.assert_allclose(np.array(functions["jac_g"](w, d)[1]), jacobian, **rough)
    upper = np.array(functions["hess_lag"](w, d, lam_f, lam_g))
    assert not np.tril(upper, -1).any()
    np.testing.assert_allclose(upper, np.triu(central(slope)), **rough)


def motion(seed: int, nx: int, nu: int, duration: float) -> PhaseGuess:
    a, b = np.random.default_rng(seed).normal(size=(2, nx + nu, 1))
    return PhaseGuess(duration, lambda s: a[:nx] + b[:nx] * s**2, lambda s: a[nx:] * np.cos(s) + b[nx:] * s)


@each_scheme
def test_pack_samples_the_guess_at_nodes_and_stages(problem, method):
    t = Transcription(problem, method, MESH)
    guess = Guess((motion(1, 2, 1, 0.9), motion(2, 3, 2, 1.7)), np.array([0.3, -1.1]))
    value = t.pack(guess) * t.scale
    np.testing.assert_allclose(value[:2], guess.parameters, rtol=1e-15)
    seen = [np.arange(2)]
    for block, fractions, moved in zip(t.blocks, MESH, guess.phases, strict=True):
        assert value[block.duration] == moved.duration
        nodes = np.r_[0, np.cumsum(fractions)]
        np.testing.assert_allclose(value[block.nodes], moved.states(nodes), atol=1e-14)
        for i, c in enumerate(method.c):
            s = nodes[:-1] + c * fractions
            np.testing.assert_allclose(value[block.stage_x[:, i]], moved.states(s), atol=1e-14)
            controls = value[block.controls].swapaxes(1, 2) @ basis(method)[i]
            np.testing.assert_allclose(controls, moved.controls(s), atol=1e-13)
        seen += [np.array([block.duration]), block.nodes.ravel(), block.stage_x.ravel(), block.controls.ravel()]
    np.testing.assert_array_equal(np.unique(np.concatenate(seen)), np.arange(t.size))  # every variable stands somewhere


@each_scheme
def test_bounds_of_the_variables(problem, method):
    t = Transcription(problem, method, MESH)
    lower, upper = (b * t.scale for b in t.bounds)
    exact = dict[str, Any](rtol=1e-15)  # a division and a multiplication
    np.testing.assert_allclose((lower[:2], upper[:2]), (problem.p_lower, problem.p_upper), **exact)
    for ph, block in zip(problem.phases, t.blocks, strict=True):
        assert (lower[block.duration], upper[block.duration]) == ph.duration
        np.testing.assert_allclose(lower[block.nodes[0, 0]], 0.5, **exact)
        np.testing.assert_allclose(upper[block.nodes[0, 0]], 0.5, **exact)
        np.testing.assert_allclose((lower[block.nodes[-1, -1]], upper[block.nodes[-1, -1]]), (-0.5, -0.5), **exact)
        free = np.r_[block.nodes[1:, 0], block.nodes[:-1, -1], block.nodes[:, 1:-1].ravel()]
        np.testing.assert_allclose(lower[free], -3, **exact)
        np.testing.assert_allclose(upper[free], 4, **exact)
        np.testing.assert_allclose(lower[block.controls], -5, **exact)
        np.testing.assert_allclose(upper[block.controls], 6, **exact)


@each_scheme
def test_row_names_are_found_by_disturbing_rows(problem, method):
    """A shift of one state's rate, one path or one design inequality moves exactly the rows that carry its name."""

    def shifted(index: int, output: int, row: int) -> Problem:
        phases, ph = list(problem.phases), problem.phases[index]
        arguments = [ca.SX.sym(f"a{k}", ph.rates.size1_in(k)) for k in range(4)]
        outputs = list(ph.rates(*arguments))
        outputs[output] = outputs[output] + ca.DM(np.eye(outputs[output].numel())[row])
        phases[index] = replace(ph, rates=ca.Function("rates", arguments, outputs))
        return replace(problem, phases=tuple(phases))

    t = Transcription(problem, method, MESH)
    w, d, _, _ = point(t)
    base = np.array(t.functions["nlp"](w, d)[1]).ravel()
    names = [t.row_name(row) for row in range(base.size)]
    assert names[-8:-5] == ["product", "growth", "difference"]
    assert names[-5:-2] == ["go x0 from 'go' to 'back'", "go x1 from 'go' to 'back'", "back x1 from 'back' to 'go'"]
    assert names[-2:] == ["duration of go and back", "duration of back"]
    np.testing.assert_array_equal(np.array(t.row_bounds)[:, -8:-2], [[-np.inf] * 3 + [0] * 3, [0] * 6])
    for index, ph in enumerate(problem.phases):
        for output, words in ((0, [f"the motion of {s} " for s in ph.x.names]), (2, [f"{g} " for g in ph.path.names])):
            for row, name in enumerate(words):
                moved = np.array(Transcription(shifted(index, output, row), method, MESH).functions["nlp"](w, d)[1]).ravel()
                expected = [n.startswith(name) and n.endswith(f"of phase {ph.name!r}") for n in names]
                np.testing.assert_array_equal(np.abs(moved - base) > 1e-9, expected)


@each_scheme
def test_path_constraints_stand_once_at_every_point(problem, method):
    """Where neighbours share a node, its path constraint is bounded once, with the interval before it."""
    t = Transcription(problem, method, MESH)
    lower, upper = t.row_bounds
    for ph, fractions in zip(problem.phases, MESH, strict=True):
        N = len(fractions)
        points = method.d * N - (N - 1 if method.c[0] == 0 else 0)
        for name, low, high in zip(ph.path.names, ph.path.lower, ph.path.upper, strict=True):
            rows = np.array([r for r in range(lower.size) if t.row_name(r).startswith(name)])
            bounded = rows[np.isfinite(lower[rows])]
            assert bounded.size == points
            np.testing.assert_array_equal((lower[bounded], upper[bounded]), ([low] * points, [high] * points))
            assert np.isposinf(upper[np.setdiff1d(rows, bounded)]).all()
    defects = [r for r in range(lower.size) if t.row_name(r).startswith("the motion")]
    assert not lower[defects].any()
    assert not upper[defects].any()
    np.testing.assert_array_equal((lower[-8:-5], upper[-8:-5]), ([-np.inf] * 3, [0] * 3))


def test_uniform_mesh(problem):
    np.testing.assert_allclose(uniform_mesh(problem, 4), np.full((2, 4), 0.25))
    with pytest.raises(UserError, match="at least 1 interval"):
        uniform_mesh(problem, 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_lower": np.array([0.0, 5.0])}, "bounds of go x1 are crossed: 5 … 4"),
        ({"x_upper": np.array([np.nan, 5.0])}, "bounds of go x0 are crossed"),
        ({"u_upper": np.array([-6.0])}, "bounds of go u0 are crossed"),
        ({"path_lower": np.array([9.0])}, "bounds of go g0 are crossed"),
        ({"u_lower": np.zeros(2)}, r"u bounds have shapes \(2,\), \(1,\), not \(1,\)"),
        ({"x_scale": np.zeros(2)}, "x scales must be 2 numbers above 0"),
        ({"duration": (2.0, 1.0)}, "durations"),
        ({"duration": (0.0, 1.0)}, "durations"),
        ({"duration": (1.0, np.inf)}, "durations"),
    ],
)
def test_malformed_phases(changes, message):
    with pytest.raises(UserError, match=message):
        phase("go", 2, 1, 1, 0, **changes)


def test_crossed_parameters():
    with pytest.raises(UserError, match="bounds of k are crossed: 2 … 1"):
        Problem((phase("go", 2, 1, 1, 0),), ("k",), np.array([2.0]), np.array([1.0]), np.ones(1))


def test_costs_and_groups_that_do_not_fit():
    with pytest.raises(UserError, match="phase 'go' adds to cost 2; there are 1, from 0"):
        Problem((replace(phase("go", 2, 1, 1, 0), costs=(2,)),))
    with pytest.raises(UserError, match=r"groups of the costs are \(0, 2\); numbers from 0 without a gap are required"):
        Problem((phase("go", 2, 1, 1, 0),), groups=(0, 2))
    with pytest.raises(UserError, match="cost rate 2, path"):
        replace(phase("go", 2, 1, 1, 0), costs=(0, 1))


@pytest.mark.parametrize(("groups", "speed", "cost"), [((0, 0), 1 / 3, 4 / 9), ((0, 1), 0.6, 0.8)])
def test_the_greatest_of_a_group_is_minimised_and_groups_are_added(groups, speed, cost):
    """x' = u in one second, costs ∫ (u − 1)² and ∫ (u + 1)² / 4. In one group they are equal at the optimum; added, the derivative
    2 (u − 1) + (u + 1) / 2 is zero."""
    x, u, p, d = (ca.SX.sym(name, size) for name, size in (("x", 1), ("u", 1), ("p", 0), ("d", 0)))
    rates = ca.Function("rates", [x, u, p, d], [u, ca.vertcat((u - 1) ** 2, (u + 1) ** 2 / 4), ca.SX(0, 1)])
    free, one = np.array([np.nan]), np.ones(1)
    x, u = (Bounded((name,), -9 * one, 9 * one, one) for name in "xu")
    ends = {"start": np.zeros(1), "end": free, "duration": (1.0, 1.0), "costs": (0, 1)}
    only = Phase(name="go", rates=rates, x=x, u=u, **ends)
    guess = Guess((PhaseGuess(1.0, lambda s: np.zeros((1, s.size)), lambda s: np.zeros((1, s.size))),), np.zeros(0))
    found = solve(Problem((only,), groups=groups), guess, intervals=4)
    assert found.cost == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(found.sample(0, np.array([0.3]))[3], speed, atol=1e-4)
    error = mesh_error(found)
    assert error.quadrature < 1e-7  # of IPOPT


def test_chains_are_what_links_join():
    p = Problem(tuple(phase(str(i), 2, 1, 0, i) for i in range(5)), ("a", "b"), *np.ones((3, 2)))
    assert p.chains == ((0,), (1,), (2,), (3,), (4,))
    linked = replace(p, links=(Link(3, 1, (0,)), Link(4, 4, (1,)), Link(0, 3, (1,))))
    assert linked.chains == ((0, 1, 3), (2,), (4,))
    alone = linked.alone((0, 1, 3))
    assert [ph.name for ph in alone.phases] == ["0", "1", "3"]
    assert alone.links == (Link(2, 1, (0,)), Link(0, 2, (1,)))
    assert linked.alone((4,)).links == (Link(0, 0, (1,)),)
    timed = replace(linked, cycles=(Cycle((2, 3), (1.0, 2.0)),))
    assert timed.chains == ((0, 1, 2, 3), (4,))
    assert timed.alone((0, 1, 2, 3)).cycles == timed.cycles
    assert timed.alone((4,)).cycles == ()
    with pytest.raises(UserError, match=r"a cycle has the phases \(5,\); there are 5, from 0"):
        replace(p, cycles=(Cycle((5,), (1.0, 2.0)),))
    with pytest.raises(UserError, match="a cycle takes"):
        replace(p, cycles=(Cycle((0, 1), (1e4, 2e4)),))
    with pytest.raises(UserError, match="a link names phase 5; there are 5, from 0"):
        replace(p, links=(Link(0, 5, (0,)),))
    with pytest.raises(UserError, match="a link names state 2 of phase '0', which has 2"):
        replace(p, links=(Link(0, 1, (2,)),))


def passing(share: float) -> Problem:
    """A mass that goes from rest to rest in 2 s with the least ∫ u² dt, and passes −0.5 after a share of the time."""
    x, u, none = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("none", 0)
    far, one = np.full(2, np.inf), np.ones(1)
    there = Boundary(share, ca.Function("there", [x, none, none], [x[0] + 0.5]), ("place",))
    mass = Phase(
        name="go",
        rates=ca.Function("rates", [x, u, none, none], [ca.vertcat(x[1], u), u**2, ca.SX(0, 1)]),
        x=Bounded(("place", "speed"), -far, far, np.ones(2)),
        u=Bounded(("force",), -np.inf * one, np.inf * one, one),
        start=np.zeros(2),
        end=np.array([1.0, 0.0]),
        duration=(2.0, 2.0),
        boundaries=(there,),
    )
    return Problem((mass,))


def test_a_boundary_within_a_phase_is_met_as_by_the_clamped_spline():
    """Of all motions through points the cubic spline has the least ∫ u² dt; a collocated motion of order 4 is one."""
    problem, spline = passing(0.3), CubicSpline([0.0, 0.6, 2.0], [0.0, -0.5, 1.0], bc_type="clamped")
    mesh = uniform_mesh(problem, 4)
    np.testing.assert_allclose(mesh[0], [0.3, 0.7 / 3, 0.7 / 3, 0.7 / 3])
    guess = PhaseGuess(2.0, lambda s: np.vstack([s, 0 * s]), lambda s: np.zeros((1, s.size)))
    solution = solve(problem, Guess((guess,), np.zeros(0)), 4, scheme("lobatto", 4))
    s = np.linspace(0, 1, 41)
    np.testing.assert_allclose(solution.at(0, s)[0], [spline(2 * s), spline(2 * s, 1)], atol=1e-7)
    row = solution.transcription.row_bounds[0].size - 1
    assert solution.transcription.row_name(row) == "place at 30% of 'go'"


def test_a_boundary_within_a_phase_needs_a_node_and_a_share_within_it():
    uneven = Transcription(passing(0.3), scheme("lobatto", 4), (np.full(4, 0.25),))
    with pytest.raises(UserError, match=r"a mesh without a node at 0\.3 of the time"):
        Solver(uneven).solve(np.zeros(uneven.size))
    with pytest.raises(UserError, match="one between 0 and 1 is required"):
        passing(1.0)
