"""The environments.  This folder is imported as ``clothgym.envs``."""

if __name__ != "clothgym.envs":
    # with the repository's root on sys.path a bare `import envs` would make a second copy of every class
    raise ImportError("this folder is the package clothgym.envs: write `import clothgym.envs`")

from clothgym.envs.definition import Observation
from clothgym.envs.drape import ClothDrapeEnv, ClothDrapeVectorEnv
from clothgym.envs.drape_gripper import ClothDrapeGripperEnv, ClothDrapeGripperVectorEnv
from clothgym.envs.episode import TaskState
from clothgym.envs.flatten import ClothFlattenEnv, ClothFlattenHardEnv, ClothFlattenHardVectorEnv, ClothFlattenVectorEnv
from clothgym.envs.fling import ClothFlingEnv, ClothFlingHardEnv, ClothFlingHardVectorEnv, ClothFlingVectorEnv
from clothgym.envs.fold import ClothFoldEnv, ClothFoldVectorEnv
from clothgym.envs.fold_goal import ClothFoldGoalEnv, ClothFoldGoalHardEnv, ClothFoldGoalHardVectorEnv, ClothFoldGoalVectorEnv
from clothgym.envs.fold_hard import ClothFoldHardEnv, ClothFoldHardVectorEnv
from clothgym.envs.gripper_task import GripperTask
from clothgym.envs.hang import ClothHangEnv, ClothHangHardEnv, ClothHangHardVectorEnv, ClothHangVectorEnv
from clothgym.envs.hook import ClothHookEnv, ClothHookHardEnv, ClothHookHardVectorEnv, ClothHookVectorEnv
from clothgym.envs.physics import Physics
from clothgym.envs.reach import ClothReachEnv, ClothReachVectorEnv
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels
from clothgym.envs.strain import ClothStrainEnv, ClothStrainVectorEnv
from clothgym.envs.task import Task
from clothgym.envs.vector import ClothVectorEnv

__all__ = [
    "ClothDrapeEnv",
    "ClothDrapeGripperEnv",
    "ClothDrapeGripperVectorEnv",
    "ClothDrapeVectorEnv",
    "ClothEnv",
    "ClothFlattenEnv",
    "ClothFlattenHardEnv",
    "ClothFlattenHardVectorEnv",
    "ClothFlattenVectorEnv",
    "ClothFlingEnv",
    "ClothFlingHardEnv",
    "ClothFlingHardVectorEnv",
    "ClothFlingVectorEnv",
    "ClothFoldEnv",
    "ClothFoldGoalEnv",
    "ClothFoldGoalHardEnv",
    "ClothFoldGoalHardVectorEnv",
    "ClothFoldGoalVectorEnv",
    "ClothFoldHardEnv",
    "ClothFoldHardVectorEnv",
    "ClothFoldVectorEnv",
    "ClothHangEnv",
    "ClothHangHardEnv",
    "ClothHangHardVectorEnv",
    "ClothHangVectorEnv",
    "ClothHookEnv",
    "ClothHookHardEnv",
    "ClothHookHardVectorEnv",
    "ClothHookVectorEnv",
    "ClothReachEnv",
    "ClothReachVectorEnv",
    "ClothStrainEnv",
    "ClothStrainVectorEnv",
    "ClothVectorEnv",
    "GripperTask",
    "Kernels",
    "Observation",
    "Physics",
    "Task",
    "TaskState",
]
