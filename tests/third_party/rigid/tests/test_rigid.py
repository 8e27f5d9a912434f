from acme_rigid import RigidSolver

from measure.testing import PoseSolverConformance


class TestRigid(PoseSolverConformance):
    plugin = RigidSolver
