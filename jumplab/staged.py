"""An assembled problem in the order of time, as solvers for optimal control want it.

Stage by stage come states, then controls; the rows of a stage are first the links to the next one, which read
D x[k+1] - F(x[k], u[k]) with D diagonal, then its other rows. What is constant in a phase, its duration say, becomes a
state of all its stages, linked by equality. Nothing is derived anew: entries of Jacobian and Hessian are only put
elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from jumplab.transcription import Assembled

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
