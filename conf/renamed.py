"""Names of keys and options that changed: whoever uses an old one is told the new one in a line."""

__all__ = ["REMOVED", "RENAMED"]

RENAMED: dict[str, str] = {  # old dotted key, or group=option, or key=choice -> the new one
    "policy": "policies.dqn",  # of a benchmark
    "agent.action_smoothness": "agent.output_basis_decay",
    "agent.relabel": "agent.hindsight_share",
    "agent.relabel_near": "agent.hindsight_near",
    "agent.relabel_width": "agent.hindsight_width",
    "controller_kind=adaptive_inverse": "controller_kind=inverse",
    "backend.guard": "backend.overflow_pump",
    "backend.guard.duty": "backend.overflow_pump.duty",
    "backend.guard.flow_ml_s": "backend.overflow_pump.flow_ml_s",
    "backend.guard.pump": "backend.overflow_pump.pump",
    "faults=foreign guard off": "faults=foreign overflow pump off",
    "faults=guard blocked": "faults=overflow pump blocked",
    "guard": "overflow_pump",  # of the fault matrix
    "guard.duty": "overflow_pump.duty",
    "guard.flow_ml_s": "overflow_pump.flow_ml_s",
    "guard.pump": "overflow_pump.pump",
    "plant.pump.guard_ml_s": "plant.pump.overflow_ml_s",
    "plant.vessel.guard_above_ml": "plant.vessel.overflow_above_ml",
    "safety.responses.guard": "safety.responses.overflow_pump",
}
REMOVED: dict[str, str] = {  # old dotted key -> why, and what to use instead
    "agent.adam_beta2": "it is the published 0.999",
    "agent.adam_eps": "it is the published 1e-8",
    "agent.average": "the last weights act",
    "agent.double": "the target is the plain maximum",
    "agent.learning_rate_decay": "the rate is constant",
    "agent.relabel_margin": "new goals lie between the task's lowest and highest setpoint",
    "agent.target_blend": "the target network is always a copy",
    "backend.addresses": "give backend.units.NAME.address=http://HOST",
    "backend.password": "it would stand in the files of a run; give PIOREACTOR_MQTT_PASSWORD or backend.password_file",
}
