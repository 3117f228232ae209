"""A humanoid robot jumps: planned by three chained optimisations, audited, simulated, and drawn.

>>> import jumplab as jl
>>> robot = jl.Robot.load("bhr")  # a name, a TOML, a URDF
>>> plan = jl.plan(jl.JumpTask(distance_m=1.0, height_m=0.5), robot)
>>> assert jl.audit(plan).passed
>>> run = jl.simulate(plan)
>>> jl.save("out", plan, run); jl.view(plan, run)

Each name below is loaded when it is first used. Errors are in ``jl.errors``, pictures and tables in
``jl.plots``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from jumplab.errors import Shown
from jumplab.robot import foreign

if TYPE_CHECKING:  # for editors and type checkers; at run time __getattr__ loads what is asked for
    from jumplab import errors as errors
    from jumplab import show as plots  # noqa: F401
    from jumplab.api import audit as audit
    from jumplab.api import load as load
    from jumplab.api import plan as plan
    from jumplab.api import save as save
    from jumplab.api import simulate as simulate
    from jumplab.api import view as view
    from jumplab.auditing.clip import judge as judge
    from jumplab.ocp import Term as Term
    from jumplab.robot.description import Robot as Robot
    from jumplab.sim.perturbation import Perturbation as Perturbation
    from jumplab.sim.scene import Scene as Scene
    from jumplab.stages.plan import JumpPlan as JumpPlan
    from jumplab.stages.planner import Planner as Planner
    from jumplab.stages.whole_body import ContactPhase as ContactPhase
    from jumplab.stages.whole_body import Contacts as Contacts
    from jumplab.stages.whole_body import Place as Place
    from jumplab.studies.atlas import Atlas as Atlas
    from jumplab.studies.chain import run_chain as run_chain
    from jumplab.studies.envelope import envelope as envelope
    from jumplab.studies.mend import mend as mend
    from jumplab.studies.record import record as record
    from jumplab.studies.trials import run_trials as run_trials
    from jumplab.task import JumpTask as JumpTask

foreign.importer = lambda: import_module("jumplab.robot_import.checkup")
_PLACES = {
    "JumpTask": "task",
    "Contacts": "stages.whole_body",
    "ContactPhase": "stages.whole_body",
    "Place": "stages.whole_body",
    "Robot": "robot",
    "Planner": "stages.planner",
    "JumpPlan": "stages.plan",
    "Term": "ocp",
    "plan": "api",
    "audit": "api",
    "judge": "auditing.clip",
    "mend": "studies.mend",
    "simulate": "api",
    "save": "api",
    "load": "api",
    "view": "api",
    "Scene": "sim",
    "Perturbation": "sim",
    "Atlas": "studies.atlas",
    "run_trials": "studies.trials",
    "run_chain": "studies.chain",
    "envelope": "studies.envelope",
    "record": "studies.record",
}
_MODULES = {"errors": "errors", "plots": "show"}
Shown.pictures = lambda: import_module("jumplab.show.cards")

__all__ = [*_PLACES, *_MODULES]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value = import_module(f"jumplab.{_MODULES[name]}")
    elif name in _PLACES:
        value = getattr(import_module(f"jumplab.{_PLACES[name]}"), name)
    elif name == "__version__":
        from jumplab.io.folder import versions

        value = versions()["jumplab"]
    else:
        raise AttributeError(
            f"module 'jumplab' has no attribute {name!r}; it has {', '.join(__all__)}"
        )
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
