"""The same jump by crocoddyl, which knows multiple shooting and DDP and no hard limits: time and quality of its answer.

Crocoddyl needs another Pinocchio than this package, so it runs in an environment of its own:
``pip install crocoddyl==3.2.1 pin==4.0.0``, then ``python peer_crocoddyl.py OUT.json DIR...`` with folders of plans
(``jumplab plan ... --out DIR``), some of each jump: their times are repeats.
The durations of launch and flight are the plan's, with flat feet; what the plan has as limits are barriers here, and
motors have neither a torque-speed line nor rotors. It moves a floating base with all joints of the robot, also where
the plan is of links in the plane or of one half of an even robot.
"""

from __future__ import annotations

import json
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import crocoddyl
import numpy as np
import pinocchio as pin

STEPS_S = 0.02, 0.01  # of its integrator
FRICTION = 0.45
REPEATS = 3
MOST, STOP = 400, 1e-3  # iterations; its stopping criterion
NEAR, FEASIBLE = 1.02, 1e-6  # within 2 % of the cost at the end, and without gaps, it might as well stop
# weights of the costs: of their squares, in the units of the residuals
PLACE, RISE, POSTURE, RATES, EFFORT, LIMITS, CONE, TILT = 1e5, 1e3, 1.0, 1e-2, 1e-4, 1e3, 1.0, 1e2


class Jump:
    """Costs and dynamics of one jump, by node."""

    def __init__(self, folder: Path, step_s: float):
        self.step_s = step_s
        self.told = json.loads((folder / "summary.json").read_text())
        tape = np.load(folder / "plan.npz")
        self.model = pin.buildModelFromXML((folder / "robot.urdf").read_text(), pin.JointModelFreeFlyer())
        self.model.gravity.linear = np.array([0.0, 0.0, -9.8])
        self.data, self.q0 = self.model.createData(), tape["q"][0]
        self.feet = [self.model.getFrameId(str(name)) for name in tape["contact_frames"]]
        pin.framesForwardKinematics(self.model, self.data, self.q0)
        self.places = [self.data.oMf[foot].copy() for foot in self.feet]
        self.com = pin.centerOfMass(self.model, self.data, self.q0).copy()
        self.state = crocoddyl.StateMultibody(self.model)
        self.motors = crocoddyl.ActuationModelFloatingBase(self.state)
        self.x0 = np.concatenate([self.q0, np.zeros(self.model.nv)])
        feet = tomllib.loads((folder / "robot.toml").read_text())["feet"]
        self.sole = np.array([feet["sole_x_m"], feet["sole_y_m"]])

    def costs(self, grounded: bool, last: bool = False, takeoff: bool = False) -> crocoddyl.CostModelSum:
        """The costs of a node; ``last`` is touchdown, ``takeoff`` the first in the air."""
        state, nu, nv, nj = self.state, self.motors.nu, self.model.nv, self.model.nv - 6
        found = crocoddyl.CostModelSum(state, nu)

        def add(name, residual, weight, activation=None):
            how = (state, activation, residual) if activation is not None else (state, residual)
            found.addCost(name, crocoddyl.CostModelResidual(*how), weight)

        weights = np.concatenate([np.zeros(3), [TILT] * 3, np.full(nj, POSTURE), np.full(nv, RATES)])
        posture = crocoddyl.ActivationModelWeightedQuad(weights)
        add("posture", crocoddyl.ResidualModelState(state, self.x0, nu), 1.0 if last else 1e-1, posture)
        limit = self.model.velocityLimit[6:], self.model.lowerPositionLimit[7:], self.model.upperPositionLimit[7:]
        low = np.concatenate([np.full(6, -np.inf), limit[1] - self.q0[7:], np.full(6, -np.inf), -limit[0]])
        high = np.concatenate([np.full(6, np.inf), limit[2] - self.q0[7:], np.full(6, np.inf), limit[0]])
        barrier = crocoddyl.ActivationModelQuadraticBarrier(crocoddyl.ActivationBounds(low, high))
        add("joint limits", crocoddyl.ResidualModelState(state, self.x0, nu), LIMITS, barrier)
        target = self.told["target"]
        if takeoff:
            speed = np.sqrt(2 * 9.8 * target["height_m"])
            momentum = np.array([0.0, 0.0, self.told["robot"]["mass_kg"] * speed, 0.0, 0.0, 0.0])
            vertical = crocoddyl.ActivationModelWeightedQuad(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
            add("rise", crocoddyl.ResidualModelCentroidalMomentum(state, momentum, nu), RISE, vertical)
        if last:
            for k, foot in enumerate(self.feet):
                way = np.array([target["distance_m"], target["side_m"], 0.0])
                goal = pin.SE3(np.eye(3), self.places[k].translation + way)
                add(f"touchdown {k}", crocoddyl.ResidualModelFramePlacement(state, foot, goal, nu), PLACE)
            return found
        add("effort", crocoddyl.ResidualModelControl(state, nu), EFFORT)
        for foot in self.feet if grounded else ():
            cone = crocoddyl.WrenchCone(np.eye(3), FRICTION, np.ptp(self.sole, axis=1))
            bounds = crocoddyl.ActivationBounds(cone.lb, cone.ub)
            residual = crocoddyl.ResidualModelContactWrenchCone(state, foot, cone, nu, True)
            add(f"cone {foot}", residual, CONE, crocoddyl.ActivationModelQuadraticBarrier(bounds))
        return found

    def node(self, grounded: bool, **where: bool):
        """One step or the end."""
        contacts, nu = crocoddyl.ContactModelMultiple(self.state, self.motors.nu), self.motors.nu
        axes, gains = pin.LOCAL_WORLD_ALIGNED, np.array([0.0, 50.0])
        for foot, place in zip(self.feet, self.places, strict=True) if grounded else ():
            contacts.addContact(f"{foot}", crocoddyl.ContactModel6D(self.state, foot, place, axes, nu, gains))
        costs, free = self.costs(grounded, **where), crocoddyl.DifferentialActionModelFreeFwdDynamics
        held = crocoddyl.DifferentialActionModelContactFwdDynamics
        made = held(self.state, self.motors, contacts, costs, 0.0, True) if grounded else None
        dynamics = made or free(self.state, self.motors, costs)
        node = crocoddyl.IntegratedActionModelEuler(dynamics, 0.0 if where.get("last") else self.step_s)
        node.u_lb, node.u_ub = -self.model.effortLimit[6:], self.model.effortLimit[6:]
        return node

    def measured(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray, n: int, steps: np.ndarray) -> dict[str, float]:
        """Measures of a motion: travel, rise from take-off at row ``n``, largest shares of torque and speed, effort."""
        pin.forwardKinematics(self.model, self.data, q[-1])
        pin.updateFramePlacements(self.model, self.data)
        ends = [self.data.oMf[foot].translation[0] for foot in self.feet]
        heights = [pin.centerOfMass(self.model, self.data, x)[2] for x in q[n:]]
        return {
            "travel_m": float(np.mean(ends) - np.mean([place.translation[0] for place in self.places])),
            "rise_m": float(max(heights) - heights[0]),
            "torque_share": float((np.abs(tau) / self.model.effortLimit[6:]).max()),
            "speed_share": float((np.abs(v[:, 6:]) / self.model.velocityLimit[6:]).max()),
            "effort": float((tau**2).sum(axis=1) @ steps),
        }

    def problem(self) -> crocoddyl.ShootingProblem:
        """Launch on flat feet, flight, touchdown."""
        n, m = (round(self.told[key] / self.step_s) for key in ("launch_s", "flight_s"))
        launch = [self.node(True) for _ in range(n)]
        flight = [self.node(False, takeoff=k == 0) for k in range(m)]
        return crocoddyl.ShootingProblem(self.x0, launch + flight, self.node(False, last=True))


def solved(jump: Jump) -> dict[str, Any]:
    """The median of some solves, as a row."""
    found = []
    for _ in range(REPEATS):
        problem, log = jump.problem(), crocoddyl.CallbackLogger()
        solver = crocoddyl.SolverBoxFDDP(problem)
        solver.setCallbacks([log])
        xs = [jump.x0] * (problem.T + 1)
        us = problem.quasiStatic(xs[:-1])
        began = time.process_time()
        done = solver.solve(xs, us, MOST, False, STOP)
        spent = time.process_time() - began
        near = next(k for k, cost in enumerate(log.costs) if cost < NEAR * solver.cost and log.ffeass[k] < FEASIBLE)
        found.append((spent, near, done, solver))
    spent, near, done, solver = sorted(found, key=lambda row: row[0])[REPEATS // 2]
    n, xs = round(jump.told["launch_s"] / jump.step_s), np.array(solver.xs)
    q, v = xs[:, : jump.model.nq], xs[:, jump.model.nq :]
    row = {"method": f"crocoddyl {crocoddyl.__version__}, {1e3 * jump.step_s:g} ms", "nodes": len(xs), "cpu_s": spent}
    row["cpu_most_s"] = max(row[0] for row in found)
    row |= {"near_cpu_s": spent * near / solver.iter, "iterations": int(solver.iter), "converged": bool(done)}
    return row | jump.measured(q, v, np.array(solver.us), n, np.full(len(solver.us), jump.step_s))


def compared(folders: list[Path]) -> list[dict[str, Any]]:
    """Rows of the plans of one jump, of the one in the middle by time, and of crocoddyl's answers with each step."""
    spent = {folder: sum(row["solve_s"] for row in Jump(folder, STEPS_S[0]).told["stages"]) for folder in folders}
    folder = sorted(folders, key=spent.get)[len(folders) // 2]
    jump, tape = Jump(folder, STEPS_S[0]), np.load(folder / "plan.npz")
    n = int(np.argmax(tape["phase"] == "flight"))
    ours = {"method": "direct", "nodes": None, "cpu_s": spent[folder], "cpu_most_s": max(spent.values())}
    ours |= {"near_cpu_s": spent[folder], "converged": True}
    ours["iterations"] = sum(row["iterations"] for row in jump.told["stages"])
    ours |= jump.measured(tape["q"], tape["v"], tape["tau"][:-1], n, np.diff(tape["t"]))
    head = {"robot": jump.told["robot"]["name"], "target": jump.told["target"]}
    return [head | row for row in (ours, *(solved(Jump(folder, step_s)) for step_s in STEPS_S))]


def main(out: Path, folders: list[Path]) -> None:
    """Solve each jump with each step, and put its plans beside."""
    jumps: dict[str, list[Path]] = {}
    for folder in folders:
        told = json.loads((folder / "summary.json").read_text())
        jumps.setdefault(json.dumps([told["robot"]["name"], told["target"]]), []).append(folder)
    rows = [row for some in jumps.values() for row in compared(some)]
    out.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
