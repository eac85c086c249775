"""How two species enter the simulated world."""

from envs.gym_adapter import REGISTERED

TASK = ("envs.coculture.task:CocultureEnv", "envs.coculture.task:CocultureVectorEnv")

REGISTERED["Coculture-v0"] = (*TASK, {})
REGISTERED["CoculturePreview-v0"] = (*TASK, {"control_min": 30.0, "episode_steps": 24, "preview_min": 360.0})
