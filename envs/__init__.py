"""The environments.  This folder is imported as ``clothgym.envs``."""

if __name__ != "clothgym.envs":
    # with the repository's root on sys.path a bare `import envs` would make a second copy of every class
    raise ImportError("this folder is the package clothgym.envs: write `import clothgym.envs`")

from clothgym.envs.canonicalize import ClothCanonicalizeEnv, ClothCanonicalizeHardEnv
from clothgym.envs.drape import ClothDrapeEnv
from clothgym.envs.drape_gripper import ClothDrapeGripperEnv
from clothgym.envs.episode import TaskState
from clothgym.envs.flatten import ClothFlattenEnv, ClothFlattenHardEnv
from clothgym.envs.flatten_shirt import ClothFlattenShirtEnv, ClothFlattenShirtHardEnv
from clothgym.envs.fling import ClothFlingEnv, ClothFlingHardEnv
from clothgym.envs.fold import ClothFoldEnv, ClothFoldHardEnv
from clothgym.envs.fold_goal import ClothFoldGoalEnv, ClothFoldGoalHardEnv
from clothgym.envs.fold_shirt import ClothFoldShirtEnv, ClothFoldShirtHardEnv
from clothgym.envs.gripper_task import GripperTask
from clothgym.envs.hang import ClothHangEnv, ClothHangHardEnv
from clothgym.envs.hook import ClothHookEnv, ClothHookHardEnv
from clothgym.envs.observing import Observation
from clothgym.envs.physics import Physics
from clothgym.envs.reach import ClothReachEnv
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.strain import ClothStrainEnv, ClothStrainVectorEnv
from clothgym.envs.task import Task
from clothgym.envs.vector import ClothVectorEnv, batched

ClothCanonicalizeHardVectorEnv = batched(ClothCanonicalizeHardEnv)
ClothCanonicalizeVectorEnv = batched(ClothCanonicalizeEnv)
ClothDrapeGripperVectorEnv = batched(ClothDrapeGripperEnv)
ClothDrapeVectorEnv = batched(ClothDrapeEnv)
ClothFlattenHardVectorEnv = batched(ClothFlattenHardEnv)
ClothFlattenShirtHardVectorEnv = batched(ClothFlattenShirtHardEnv)
ClothFlattenShirtVectorEnv = batched(ClothFlattenShirtEnv)
ClothFlattenVectorEnv = batched(ClothFlattenEnv)
ClothFlingHardVectorEnv = batched(ClothFlingHardEnv)
ClothFlingVectorEnv = batched(ClothFlingEnv)
ClothFoldGoalHardVectorEnv = batched(ClothFoldGoalHardEnv)
ClothFoldGoalVectorEnv = batched(ClothFoldGoalEnv)
ClothFoldHardVectorEnv = batched(ClothFoldHardEnv)
ClothFoldShirtHardVectorEnv = batched(ClothFoldShirtHardEnv)
ClothFoldShirtVectorEnv = batched(ClothFoldShirtEnv)
ClothFoldVectorEnv = batched(ClothFoldEnv)
ClothHangHardVectorEnv = batched(ClothHangHardEnv)
ClothHangVectorEnv = batched(ClothHangEnv)
ClothHookHardVectorEnv = batched(ClothHookHardEnv)
ClothHookVectorEnv = batched(ClothHookEnv)
ClothReachVectorEnv = batched(ClothReachEnv)

__all__ = [
    "ClothCanonicalizeEnv", "ClothCanonicalizeHardEnv", "ClothCanonicalizeHardVectorEnv", "ClothCanonicalizeVectorEnv",
    "ClothDrapeEnv", "ClothDrapeGripperEnv", "ClothDrapeGripperVectorEnv", "ClothDrapeVectorEnv", "ClothEnv", "ClothFlattenEnv",
    "ClothFlattenHardEnv", "ClothFlattenHardVectorEnv", "ClothFlattenShirtEnv", "ClothFlattenShirtHardEnv",
    "ClothFlattenShirtHardVectorEnv", "ClothFlattenShirtVectorEnv",
    "ClothFlattenVectorEnv", "ClothFlingEnv", "ClothFlingHardEnv", "ClothFlingHardVectorEnv", "ClothFlingVectorEnv", "ClothFoldEnv",
    "ClothFoldGoalEnv", "ClothFoldGoalHardEnv", "ClothFoldGoalHardVectorEnv", "ClothFoldGoalVectorEnv", "ClothFoldHardEnv",
    "ClothFoldHardVectorEnv", "ClothFoldShirtEnv", "ClothFoldShirtHardEnv", "ClothFoldShirtHardVectorEnv",
    "ClothFoldShirtVectorEnv", "ClothFoldVectorEnv", "ClothHangEnv", "ClothHangHardEnv", "ClothHangHardVectorEnv",
    "ClothHangVectorEnv", "ClothHookEnv", "ClothHookHardEnv", "ClothHookHardVectorEnv", "ClothHookVectorEnv", "ClothReachEnv",
    "ClothReachVectorEnv", "ClothStrainEnv", "ClothStrainVectorEnv", "ClothVectorEnv", "GripperTask", "Kernels", "Observation",
    "Physics", "Task", "TaskState",
]  # fmt: skip
