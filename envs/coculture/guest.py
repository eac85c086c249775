"""Registration of two species in the simulation: environments, plant settings, strain, sensor, option `pair`."""

from conf import schema
from envs.coculture.pair import named_pair
from envs.coculture.second import OfPlant, of_pair, of_plant, sensor, strain
from envs.gym_adapter import REGISTERED
from envs.plant import plant, strains
from envs.plant.plant import PlantConfig

TASK = ("envs.coculture.task:CocultureEnv", "envs.coculture.task:CocultureVectorEnv")

REGISTERED["Coculture-v0"] = (*TASK, {})
REGISTERED["CoculturePreview-v0"] = (*TASK, {"control_min": 30.0, "episode_steps": 24, "preview_min": 360.0})
schema.add(PlantConfig, OfPlant)
strains.add_law("pair", lambda config, activation, number: of_plant(config).pair.curve(number))
plant.STRAINS.append(strain)
plant.LIGHTS.append(sensor)
plant.OPTIONS["pair"] = (
    "ecoli_pputida", "the two species: a preset or a pair.yaml", lambda config, name: of_pair(config, named_pair(name))
)  # fmt: skip
