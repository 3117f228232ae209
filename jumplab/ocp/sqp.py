"""Coming near a solution in few steps: Gauss-Newton with a QP solver that knows the order of time (HPIPM).

Each step solves the problem with its rows linearised and its costs, which are sums of squares, without their curvature.
That QP is convex and its solver takes a stage at a time, so a step costs less than one of the interior-point method on
the whole problem, and many limits may become active at once. It leaves the last digits to that method.
"""

from __future__ import annotations

from contextlib import redirect_stdout
from dataclasses import dataclass, field
from io import StringIO

import casadi as ca
import numpy as np

from jumplab.errors import SolverError
from jumplab.ocp.assembly import Assembled

# staged ------------------------------------------------------------------------------------------
PROBE = 0.3  # our choice: any point will do to see that links have a slope
FLAT = 1e-6  # our choice: a smaller slope, scaled, links nothing


@dataclass
class Stages:
    """What belongs to which stage.

    Attributes
    ----------
    states, controls : for each stage, indices into the problem's variables. A control that is a constant of the next
        phase is that constant before it takes effect.
    nodes : for each variable its stage; -1 for constants.
    phase_of : for each variable the number of the phase whose constant it is; -1 for others.
    starts : for each phase its first stage.
    """

    states: list[np.ndarray] = field(default_factory=list)
    controls: list[list] = field(default_factory=list)
    nodes: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    phase_of: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    starts: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, a: Assembled) -> Stages:
        """The stages of a problem: its nodes, phase after phase."""
        out = cls(nodes=np.full(a.size, -1), phase_of=np.full(a.size, -1))
        for number, layout in enumerate(a.layouts.values()):
            out.starts.append(len(out.states))
            out.phase_of[layout.constants()] = number
            n = layout.phase.intervals
            for k in range(n + 1):
                jerks = layout.jerk(k) if k < n else np.zeros(0, int)
                out.nodes[np.concatenate([layout.node(k), jerks])] = len(out.states)
                out.states.append(np.concatenate([layout.constants(), layout.node(k)]))
                out.controls.append(jerks.tolist())
        return out

    def phase(self, stage: int | np.ndarray) -> np.ndarray:
        """Number of the phase that a stage belongs to."""
        return np.searchsorted(self.starts, stage, side="right") - 1


class StagedOrder:
    """Where the variables, rows and derivatives' entries of an assembled problem stand in the order of time.

    Attributes
    ----------
    N, nx, nu, ng : last stage; numbers of states, controls and rows besides links, stage by stage.
    source : (nw,) the problem's variable that each staged one copies.
    copy : (n,) the staged place of each variable; of a constant, of its first copy.
    kept, place : (n_rows,) whether a row can be told stage by stage, and where it stands then.
    links : (n, 3) further rows, their next and their present variable: copies of what is constant.
    """

    def __init__(self, a: Assembled):
        self.a, stages = a, Stages.of(a)
        self._rows, self._cols = (np.array(z, int) for z in a.jac_g.sparsity_out(1).get_triplet())
        stage = self._stage_of_rows(stages)
        at = self._stage_of_columns(stages, stage)
        known = self._link_rows(stages, stage, at)
        self._number_variables(stages, known)
        self._number_rows(stages, stage, known)
        self._used = np.flatnonzero(self.kept[self._rows])
        self._jac_at = self.place[self._rows[self._used]], self._where(stages, at[self._used], self._cols[self._used])
        self._hess_at = self._place_hessian(stages)

    def _stage_of_rows(self, stages) -> np.ndarray:
        """The stage of each row: that of its node, and for rows that join phases, the last of the phase before."""
        starts = dict(zip(self.a.layouts, stages.starts, strict=True))
        stage = np.array([starts[r.owner] + r.node if r.owner in starts else -1 for r in self.a.rows])
        of_entry = stages.nodes[self._cols]
        for row in np.flatnonzero(stage < 0):
            found = of_entry[(self._rows == row) & (of_entry >= 0)].min()
            stage[row] = found - 1 if self.a.rows[row].term.identity and found in stages.starts else found
        return stage

    def _stage_of_columns(self, stages, stage) -> np.ndarray:
        """The stage whose copy each entry of the Jacobian belongs to."""
        own, phase = stage[self._rows], stages.phase_of[self._cols]
        at = np.where(phase < 0, stages.nodes[self._cols], np.where(phase == stages.phase(own), own, own + 1))
        identity = np.array([row.term.identity for row in self.a.rows])
        far = (at != own) & ~((at == own + 1) & identity[self._rows])
        self.kept = ~np.isin(np.arange(self.a.n_rows), self._rows[far])
        if np.any(identity & ~self.kept):
            raise ValueError(f"{self.a.problem.name}: a link joins more than two neighbouring nodes")
        return at

    def _link_rows(self, stages, stage, at) -> dict:
        """(stage, variable) -> the row that says what it becomes."""
        a = self.a
        slopes = np.array(a.jac_g(np.full(a.size, PROBE), np.full(a.p_size, PROBE))[1].nonzeros())
        ahead = np.flatnonzero((at == stage[self._rows] + 1) & self.kept[self._rows])
        rows, known = self._rows[ahead], dict(zip(zip(at[ahead], self._cols[ahead], strict=True), self._rows[ahead],
                                                  strict=True))  # fmt: skip
        if np.any(np.abs(slopes[ahead]) < FLAT) or not len(set(rows)) == len(rows) == len(known):
            raise ValueError(f"{a.problem.name}: a row meant as a link does not say what one variable becomes")
        return known

    def _number_variables(self, stages, known) -> None:
        """Sets the order of the variables."""
        for k in stages.starts[1:]:  # constants that no link sets are chosen at the end of the phase before
            constants = stages.states[k][stages.phase_of[stages.states[k]] >= 0]
            stages.controls[k - 1] = stages.controls[k - 1] + [v for v in constants if (k, v) not in known]
        self.nx, self.nu = [len(x) for x in stages.states], [len(x) for x in stages.controls]
        self.N, self._first = len(self.nx) - 1, np.cumsum([0, *np.add(self.nx, self.nu)])[:-1]
        pieces = zip(stages.states, stages.controls, strict=True)
        self.source = np.concatenate([np.concatenate([states, controls]).astype(int) for states, controls in pieces])
        self.copy = np.zeros(self.a.size, int)
        own = np.flatnonzero(stages.phase_of[self.source] < 0)
        self.copy[self.source[own]] = own
        for k in stages.starts:
            self.copy[stages.states[k]] = self._first[k] + np.arange(self.nx[k])

    def _where(self, stages, k, v) -> np.ndarray:
        """Staged places of variables ``v``, the constants among them as states of the stages ``k``."""
        start = np.array(stages.starts)[stages.phase(k)]
        return np.where(stages.phase_of[v] >= 0, self._first[k] + self.copy[v] - self._first[start], self.copy[v])

    def _next(self, stages, k, v) -> int:
        """The staged place at stage ``k`` of what is copied to the next."""
        if stages.phase_of[v] < 0:
            raise ValueError(f"{self.a.problem.name}: nothing says what a variable of stage {k + 1} follows from")
        if stages.phase(k) == stages.phase_of[v]:
            return int(self._where(stages, k, v))
        return int(self._first[k] + self.nx[k] + stages.controls[k].index(v))

    def _number_rows(self, stages, stage, known) -> None:
        """Sets the places of the rows and the links that copy constants."""
        self.place, links, self.ng, at = np.full(self.a.n_rows, -1), [], [], 0
        linking = set(known.values())
        others = [[] for _ in range(self.N + 1)]
        for row, k in enumerate(stage):
            if row not in linking and self.kept[row]:
                others[k].append(row)
        for k in range(self.N + 1):
            for i, v in enumerate(stages.states[k + 1] if k < self.N else ()):
                if (k + 1, v) in known:
                    self.place[known[k + 1, v]] = at
                else:
                    links.append((at, self._first[k + 1] + i, self._next(stages, k, v)))
                at += 1
            self.place[others[k]] = at + np.arange(len(others[k]))
            self.ng.append(len(others[k]))
            at += len(others[k])
        self.links, self.n_rows = np.array(links, int).reshape(-1, 3), at

    def _place_hessian(self, stages) -> tuple:
        """Staged (row, column) of each entry of the Gauss-Newton Hessian.

        A constant meets a variable of a node there, another constant of its phase at their first stage, and one of the
        next phase at the end of its own, where that is chosen.
        """
        i, j = (np.array(z, int) for z in self.a.gauss_newton.sparsity_out(0).get_triplet())
        nodes, phase = stages.nodes, stages.phase_of
        k = np.maximum(nodes[i], nodes[j])
        both = k < 0
        k[both] = np.array(stages.starts)[phase[i[both]]]
        apart = (nodes[i] >= 0) & (nodes[j] >= 0) & (nodes[i] != nodes[j])
        for x in (i, j):
            apart |= ~both & (phase[x] >= 0) & (phase[x] != stages.phase(k))
        if apart.any():
            raise ValueError(f"{self.a.problem.name}: a cost joins different nodes")
        at = [self._where(stages, k, i), self._where(stages, k, j)]
        for e in np.flatnonzero(both & (phase[i] != phase[j])):
            v, w = sorted((i[e], j[e]))
            last = stages.starts[phase[w]] - 1
            at[0][e], at[1][e] = self._where(stages, last, v), self._next(stages, last, w)
        return tuple(at)

    # values -------------------------------------------------------------------------------------------------------
    def jacobian(self, values: ca.MX) -> ca.MX:
        """The staged Jacobian from the entries of the problem's own."""
        n, rows, cols = len(self.links), *self._jac_at
        one = ca.DM.ones(n)
        values = ca.vertcat(values[self._used.tolist()], one, -one)
        rows = np.concatenate([rows, self.links[:, 0], self.links[:, 0]])
        cols = np.concatenate([cols, self.links[:, 1], self.links[:, 2]])
        return _matrix(values, rows, cols, (self.n_rows, len(self.source)))

    def hessian(self, values: ca.MX) -> ca.MX:
        """The staged symmetric Hessian from the entries of the problem's Gauss-Newton Hessian (upper triangle)."""
        i, j = self._hess_at
        off = np.flatnonzero(i != j)
        values = ca.vertcat(values, values[off.tolist()])
        nw = len(self.source)
        return _matrix(values, np.concatenate([i, j[off]]), np.concatenate([j, i[off]]), (nw, nw))


def _matrix(values: ca.MX, rows: np.ndarray, cols: np.ndarray, shape: tuple[int, int]) -> ca.MX:
    """Sparse matrix of entries that do not meet."""
    order = np.lexsort((rows, cols))
    pattern = ca.Sparsity.triplet(*shape, rows[order].tolist(), cols[order].tolist())
    return ca.MX(pattern, values[order.tolist()])


# approach ------------------------------------------------------------------------------------------
STEPS = 7  # our choice: further ones cost more than they save the solve that follows
SHORTEST = 0.2  # our choice: share of a step below which it is taken all the same; the next linearisation helps more
FREE = 1e6  # our choice: stands for no limit, scaled; HPIPM takes finite bounds only
# our choice: a step is only a step; with HPIPM's own tolerances (1e-8) it takes half as long again and leads no nearer
HPIPM = {"mode": "speed", "iter_max": 30, "res_g_max": 1e-2, "res_b_max": 1e-4, "res_d_max": 1e-4, "res_m_max": 1e-3}
PENALTY_SHARE = 99  # our choice: percentile of the multipliers that the penalty must exceed; single ones are larger
DESCENT = 1e-4  # Armijo's usual share


class Approach:
    """Gauss-Newton steps for one assembled problem, built once."""

    def __init__(self, a: Assembled):
        self.a, self.order = a, StagedOrder(a)
        self._step = self._build()

    def _build(self) -> ca.Function:
        """(x, p, box, rows) -> step, multipliers of the rows, cost, its descent, rows."""
        a, o, n = self.a, self.order, len(self.order.source)
        x, p = ca.MX.sym("x", a.size), ca.MX.sym("p", a.p_size)
        low, high = ca.MX.sym("low", a.size), ca.MX.sym("high", a.size)
        row_low, row_high = ca.MX.sym("row_low", a.n_rows), ca.MX.sym("row_high", a.n_rows)
        (g, jac), (f, slope) = a.jac_g(x, p), a.grad_f(x, p)
        hess, jac = o.hessian(a.gauss_newton(x, p).nz[:]), o.jacobian(jac.nz[:])
        kept = np.flatnonzero(o.kept)
        put = ca.DM.triplet(o.place[kept].tolist(), kept.tolist(), ca.DM.ones(len(kept)), o.n_rows, a.n_rows)
        spread = ca.DM.triplet(o.copy.tolist(), list(range(a.size)), ca.DM.ones(a.size), n, a.size)
        far = spread @ ca.DM.ones(a.size) - 1  # -1 for further copies of constants, which no bound is needed for
        qp = _qp_solver(o, hess.sparsity(), jac.sparsity())
        found = qp(h=hess, g=spread @ slope, a=jac, lba=put @ _finite(row_low - g), uba=put @ _finite(row_high - g),
                   lbx=spread @ _finite(low - x) + FREE * far, ubx=spread @ _finite(high - x) - FREE * far)  # fmt: skip
        step, lam = found["x"][o.copy.tolist()], put.T @ found["lam_a"]
        return ca.Function("step", [x, p, low, high, row_low, row_high], [step, lam, f, ca.dot(slope, step), g])

    def solve(self, x: np.ndarray, p: np.ndarray, box: tuple, rows: tuple) -> tuple[np.ndarray, int]:
        """From ``x`` towards a solution.

        Parameters
        ----------
        x, p : start (n,) within ``box``, parameters.  box, rows : (lower, upper) of variables and of rows.

        Returns
        -------
        x, steps : a point near the solution, its rows not yet met, and the number of steps.

        Raises
        ------
        SolverError
            If a QP has no solution, or a step is no number.
        """
        penalty = 0.0
        for count in range(1, STEPS + 1):
            step, lam, f, descent, g = (y.full().ravel() for y in self._step(x, p, *box, *rows))
            if not np.all(np.isfinite(step)) or not np.all(np.isfinite(lam)):
                raise SolverError(f"{self.a.problem.name}: step {count} of the approach is no number",
                                  stage=self.a.problem.name, status="approach")  # fmt: skip
            beyond = _beyond(g, rows)
            penalty = max(penalty, float(np.percentile(np.abs(lam), PENALTY_SHARE)))
            merit, slope = f[0] + penalty * beyond, descent[0] - penalty * beyond
            share = 1.0
            while share > SHORTEST:
                f, g = (y.full().ravel() for y in self.a.nlp(x + share * step, p))
                if f[0] + penalty * _beyond(g, rows) <= merit + DESCENT * share * slope:
                    break
                share /= 2
            x = np.clip(x + share * step, *box)
        return x, count


def _qp_solver(order: StagedOrder, hess: ca.Sparsity, jac: ca.Sparsity) -> ca.Function:
    """HPIPM for QPs of these patterns in that order."""
    options = {"N": order.N, "nx": order.nx, "nu": order.nu, "ng": order.ng, "inf": FREE, "hpipm": HPIPM,
               "error_on_fail": False, "print_time": False}  # fmt: skip
    with redirect_stdout(StringIO()):  # making it, CasADi tells the stages' sizes
        return ca.conic("qp", "hpipm", {"h": hess, "a": jac}, options)


def _finite(values: ca.MX) -> ca.MX:
    return ca.fmax(ca.fmin(values, FREE), -FREE)


def _beyond(g: np.ndarray, rows: tuple) -> float:
    return float(np.maximum(np.maximum(rows[0] - g, g - rows[1]), 0.0).sum())
