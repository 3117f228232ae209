"""Gauss-Newton steps towards a solution, each a QP whose solver knows the order of time (HPIPM).

A step solves the problem with its rows linearised and its costs, which are sums of squares, without their curvature.
That QP is convex and is solved stage by stage, so a step costs less than one of ipopt on the whole problem, and many
limits may become active at once. The last digits are left to ipopt.

Beside a solution steps go all the way: each is held, ever more firmly, to where it starts, so that what the rows'
curvature leaves shrinks by orders of magnitude a step. They end in a point that meets every row, a little dearer than
the optimum. From another target's solution that point is a plan.
"""

from __future__ import annotations

from contextlib import redirect_stdout
from functools import cached_property
from io import StringIO

import casadi as ca
import numpy as np

from jumplab.errors import SolverError
from jumplab.ocp.assembly import Assembled, Posed
from jumplab.ocp.derivatives import gather, scatter

PROBE = 0.3  # scaled; any point will do to see that links have a slope
FLAT = 1e-6  # scaled; a smaller slope links nothing
STEPS = 7  # further ones cost more than they save the solve that follows
SHORTEST = 0.2  # share of a step below which it is taken all the same; the next linearisation helps more
FREE = 1e6  # scaled; stands for no limit, as HPIPM takes finite bounds only
# looser than HPIPM's own tolerances of 1e-8: a step is only a step
HPIPM = {"mode": "speed", "iter_max": 30, "res_g_max": 1e-2, "res_b_max": 1e-4, "res_d_max": 1e-4, "res_m_max": 1e-3}
# of steps to the end; what they leave must be no more than what ipopt leaves
HPIPM_CLOSE = {"mode": "speed", "iter_max": 50}
HPIPM_CLOSE |= {"res_g_max": 1e-4, "res_b_max": 1e-8, "res_d_max": 1e-8, "res_m_max": 1e-6}
# weights of the square of a step, scaled; weaker first ones save 0.1 % of the cost and take a step more each; rises of
# ten take a step more where two would do, and save nothing; three weights alone failed in 4 of 17 re-plans
HOLDS = (10.0, 300.0, 1e4, 1e5)
MET = 1e-6  # scaled; rows so close to their limits are met, as for ipopt
PENALTY_SHARE = 99  # [%] percentile of the multipliers that the penalty must exceed; single ones are larger
DESCENT = 1e-4  # Armijo's usual share


class TimeOrder:
    """Where the variables, rows and derivatives' entries of an assembled problem stand in the order of time.

    A stage is a node, phase after phase. Its states are the phase's constants and the node's variables; its controls
    are the jerks, and at the end of a phase those constants of the next that no row says. Each row stands at a stage;
    a link says what one state of the next stage becomes.

    Attributes
    ----------
    N, nx, nu, ng : last stage; numbers of states, controls and rows besides links, stage by stage.
    source : (nw,) the problem's variable that each one in the order of time copies.
    copy : (n,) the place of each variable; of a constant, of its first copy as a state.
    local, place : (n_rows,) whether a row can be told stage by stage, and where it stands then.
    links : (n, 3) further rows, their next and their present variable: copies of what is constant.
    """

    def __init__(self, a: Assembled):
        self.a = a
        self._rows, self._cols = (np.array(z, int) for z in a.jac_g.sparsity_out(1).get_triplet())
        self._read_stages()
        stage = self._stage_of_rows()
        at = self._stage_of_columns(stage)
        known = self._link_rows(stage, at)
        self._number_variables(known)
        self._number_rows(stage, known)
        self._used = np.flatnonzero(self.local[self._rows])
        self._jac_at = self.place[self._rows[self._used]], self._table[at[self._used], self._cols[self._used]]
        self._hess_at = self._place_hessian()

    def _read_stages(self) -> None:
        """States and controls of each stage; of each variable its stage, or the phase whose constant it is, else -1."""
        self._states, self._controls, starts = [], [], []
        self._stage, self._phase = np.full(self.a.size, -1), np.full(self.a.size, -1)
        for number, layout in enumerate(self.a.layouts.values()):
            starts.append(len(self._states))
            self._phase[layout.constants] = number
            for node, jerks in zip(layout.nodes, [*layout.jerks, np.zeros(0, int)], strict=True):
                self._stage[np.concatenate([node, jerks])] = len(self._states)
                self._states.append([*layout.constants, *node])
                self._controls.append([*jerks])
        self._starts = np.array(starts)

    def _stage_of_rows(self) -> np.ndarray:
        """The stage of each row: that of its node, and for rows that join phases, the last of the phase before."""
        starts = dict(zip(self.a.layouts, self._starts, strict=True))
        stage = np.array([starts[r.owner] + r.node if r.owner in starts else -1 for r in self.a.rows])
        of_entry = self._stage[self._cols]
        for row in np.flatnonzero(stage < 0):
            found = of_entry[(self._rows == row) & (of_entry >= 0)].min()
            stage[row] = found - 1 if self.a.rows[row].term.identity and found in self._starts else found
        return stage

    def _stage_of_columns(self, stage: np.ndarray) -> np.ndarray:
        """The stage whose copy each entry of the Jacobian belongs to."""
        own, phase = stage[self._rows], self._phase[self._cols]
        own_phase = np.searchsorted(self._starts, own, side="right") - 1
        at = np.where(phase < 0, self._stage[self._cols], np.where(phase == own_phase, own, own + 1))
        identity = np.array([row.term.identity for row in self.a.rows])
        far = (at != own) & ~((at == own + 1) & identity[self._rows])
        self.local = ~np.isin(np.arange(self.a.n_rows), self._rows[far])
        if np.any(identity & ~self.local):
            raise ValueError(f"{self.a.problem.name}: a link joins more than two neighbouring nodes")
        return at

    def _link_rows(self, stage: np.ndarray, at: np.ndarray) -> dict[tuple[int, int], int]:
        """(stage, variable) -> the row that says what it becomes."""
        a = self.a
        slopes = np.array(a.jac_g(np.full(a.size, PROBE), np.full(a.p_size, PROBE))[1].nonzeros())
        ahead = np.flatnonzero((at == stage[self._rows] + 1) & self.local[self._rows])
        rows = self._rows[ahead]
        known = dict(zip(zip(at[ahead], self._cols[ahead], strict=True), rows, strict=True))
        if np.any(np.abs(slopes[ahead]) < FLAT) or not len(set(rows)) == len(rows) == len(known):
            raise ValueError(f"{a.problem.name}: a row meant as a link does not say what one variable becomes")
        return known

    def _number_variables(self, known: dict) -> None:
        """Sets the order of the variables, and a table of their places (stages, n), -1 where a stage has no copy."""
        for k in self._starts[1:]:  # constants that no link sets are chosen at the end of the phase before
            self._controls[k - 1] += [v for v in self._states[k] if self._phase[v] >= 0 and (k, v) not in known]
        self.nx, self.nu = [len(x) for x in self._states], [len(x) for x in self._controls]
        self.N, self._table, source = len(self.nx) - 1, np.full((len(self.nx), self.a.size), -1), []
        for k, (states, controls) in enumerate(zip(self._states, self._controls, strict=True)):
            self._table[k, states + controls] = len(source) + np.arange(len(states) + len(controls))
            source += states + controls
        self.source = np.array(source)
        home = np.where(self._phase < 0, self._stage, self._starts[self._phase])
        self.copy = self._table[home, np.arange(self.a.size)]

    def _number_rows(self, stage: np.ndarray, known: dict) -> None:
        """Sets the places of the rows and the links that copy constants."""
        self.place, links, self.ng, at = np.full(self.a.n_rows, -1), [], [], 0
        free = self.local & ~np.isin(np.arange(self.a.n_rows), list(known.values()))
        for k in range(self.N + 1):
            for v in self._states[k + 1] if k < self.N else ():
                if (k + 1, v) in known:
                    self.place[known[k + 1, v]] = at
                else:
                    links.append((at, self._table[k + 1, v], self._table[k, v]))
                at += 1
            others = np.flatnonzero(free & (stage == k))
            self.place[others] = at + np.arange(len(others))
            self.ng.append(len(others))
            at += len(others)
        self.links, self.n_rows = np.array(links, int).reshape(-1, 3), at
        if np.any(self.links < 0):
            k = self._stage[self.source[self.links[self.links[:, 2] < 0, 1]]].min()
            raise ValueError(f"{self.a.problem.name}: nothing says what a variable of stage {k} follows from")

    def _place_hessian(self) -> tuple[np.ndarray, np.ndarray]:
        """(row, column) of each entry of the Gauss-Newton Hessian.

        A constant meets a variable of a node there, another constant of its phase at their first stage, and one of the
        next phase at the end of its own, where that is chosen.
        """
        i, j = (np.array(z, int) for z in self.a.gauss_newton.sparsity_out(0).get_triplet())
        phase, k = self._phase, np.maximum(self._stage[i], self._stage[j])
        start = self._starts[np.maximum(phase[i], phase[j])]
        k = np.where(k >= 0, k, np.where(phase[i] == phase[j], start, start - 1))
        rows, cols = self._table[k, i], self._table[k, j]
        if np.any(np.minimum(rows, cols) < 0):
            raise ValueError(f"{self.a.problem.name}: a cost joins different nodes")
        return rows, cols

    def jacobian(self, values: ca.MX) -> ca.MX:
        """The Jacobian in the order of time, from the entries of the problem's own."""
        one, (rows, after, before) = ca.DM.ones(len(self.links)), self.links.T
        own = (values[self._used.tolist()], *self._jac_at)
        return gather([own, (one, rows, after), (-one, rows, before)], (self.n_rows, len(self.source)))

    def hessian(self, values: ca.MX) -> ca.MX:
        """The symmetric Hessian in the order of time, from the upper triangle of the problem's Gauss-Newton Hessian."""
        i, j = self._hess_at
        off = np.flatnonzero(i != j)
        size = len(self.source)
        return gather([(values, i, j), (values[off.tolist()], j[off], i[off])], (size, size))


class GaussNewton:
    """Gauss-Newton steps for one assembled problem, built once."""

    def __init__(self, a: Assembled):
        self.a, self.order = a, TimeOrder(a)

    @cached_property
    def _step(self) -> ca.Function:
        return self._build(HPIPM)

    @cached_property
    def _held_step(self) -> ca.Function:
        return self._build(HPIPM_CLOSE, held=True)

    def _build(self, how: dict, held: bool = False) -> ca.Function:
        """(x, p, box, rows, if ``held`` the weight of the step's square) -> step, multipliers of the rows, cost, its
        descent, rows, multipliers of the variables' bounds."""
        a, o, n = self.a, self.order, len(self.order.source)
        x, p = ca.MX.sym("x", a.size), ca.MX.sym("p", a.p_size)
        low, high = ca.MX.sym("low", a.size), ca.MX.sym("high", a.size)
        row_low, row_high = ca.MX.sym("row_low", a.n_rows), ca.MX.sym("row_high", a.n_rows)
        (g, jac), (f, slope) = a.jac_g(x, p), a.grad_f(x, p)
        hess, jac = o.hessian(a.gauss_newton(x, p).nz[:]), o.jacobian(jac.nz[:])
        local = np.flatnonzero(o.local)
        put = scatter(o.place[local], o.n_rows) @ scatter(local, a.n_rows).T
        spread = scatter(o.copy, n)
        far = FREE * (spread @ ca.DM.ones(a.size) - 1)  # further copies of constants need no bound
        options = {"N": o.N, "nx": o.nx, "nu": o.nu, "ng": o.ng, "inf": FREE, "hpipm": how}
        options |= {"error_on_fail": False, "print_time": False}
        hold = ca.MX.sym("hold", int(held))
        if held:
            hess += hold * ca.DM.eye(n)
        with redirect_stdout(StringIO()):  # making it, CasADi tells the stages' sizes
            qp = ca.conic("qp", "hpipm", {"h": hess.sparsity(), "a": jac.sparsity()}, options)
        rows = {"lba": put @ _finite(row_low - g), "uba": put @ _finite(row_high - g)}
        box = {"lbx": spread @ _finite(low - x) + far, "ubx": spread @ _finite(high - x) - far}
        found = qp(h=hess, g=spread @ slope, a=jac, **rows, **box)
        (step, lam_x), lam = (found[key][o.copy.tolist()] for key in ("x", "lam_x")), put.T @ found["lam_a"]
        given = [x, p, low, high, row_low, row_high, *[hold] * held]
        return ca.Function("step", given, [step, lam, f, ca.dot(slope, step), g, lam_x])

    def steps(self, posed: Posed) -> tuple[np.ndarray, int]:
        """A point (n,) near a solution, its rows not yet met, and the number of steps that led to it.

        Raises :class:`SolverError` if a QP has no solution, or a step is no number.
        """
        x, p, penalty, name = posed.x0, posed.p, 0.0, self.a.problem.name
        for count in range(1, STEPS + 1):
            step, lam, f, descent, g, _ = (y.full().ravel() for y in self._step(x, p, *posed.box, *posed.rows))
            if not np.all(np.isfinite(step)) or not np.all(np.isfinite(lam)):
                said = f"{name}: step {count} of the approach is no number"
                raise SolverError(said, stage=name, status="approach")
            beyond = posed.beyond(g).sum()
            penalty = max(penalty, float(np.percentile(np.abs(lam), PENALTY_SHARE)))
            merit, slope = f[0] + penalty * beyond, descent[0] - penalty * beyond
            share = 1.0
            while share > SHORTEST:
                f, g = (y.full().ravel() for y in self.a.nlp(x + share * step, p))
                if f[0] + penalty * posed.beyond(g).sum() <= merit + DESCENT * share * slope:
                    break
                share /= 2
            x = np.clip(x + share * step, *posed.box)
        return x, count

    def settled(self, posed: Posed) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """A point (n,) close to the start that meets every row, with multipliers of bounds and rows, and the number of
        steps that led to it.

        Raises :class:`SolverError` if rows are still violated after the last step.
        """
        x, name = posed.x0, self.a.problem.name
        for count, hold in enumerate(HOLDS, 1):
            step, lam_g, *_, lam_x = (
                y.full().ravel() for y in self._held_step(x, posed.p, *posed.box, *posed.rows, hold)
            )
            x = np.clip(x + step, *posed.box)
            g = self.a.nlp(x, posed.p)[1].full().ravel()
            left = float(np.max(posed.beyond(g), initial=0.0)) if np.all(np.isfinite(g)) else np.inf
            if left <= MET:
                return x, lam_x, lam_g, count
        said = f"{name}: rows are still off by {left:.1e} (scaled) after {count} steps from a neighbour"
        raise SolverError(said, stage=name, status="not settled")


def _finite(values: ca.MX) -> ca.MX:
    return ca.fmax(ca.fmin(values, FREE), -FREE)
