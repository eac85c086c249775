"""Policies with their certificates. A policy is proven once in a process, whoever asks for its certificate."""

from functools import cache
from pathlib import Path
from typing import Any

from dqn import policy as policies
from dqn.policy import Policy, fingerprints
from envs.task import EnvConfig
from experiments.certification import certificate
from experiments.certification.config import CertifyConfig
from experiments.certification.judge import Certificate, certify
from experiments.cli import files
from experiments.laws.density.learned import settings

ASKED = CertifyConfig(env=EnvConfig(), setpoints=(0.4, 0.8), trajectories=0, full_pumps=())


class _Known:
    """A policy and a question, equal to another of the same fingerprints and values."""

    def __init__(self, policy: Policy, config: CertifyConfig) -> None:
        self.policy, self.config = policy, config
        self.key = repr((sorted(fingerprints(policy).items()), config))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Known) and self.key == other.key


@cache
def _certify(known: _Known) -> Certificate:
    return certify(known.policy, known.config)


def proven(policy: Policy, config: CertifyConfig = ASKED) -> Certificate:
    """The certificate of a policy, from memory where it was proven before."""
    return _certify(_Known(policy, config))


def written(path: Path, given: Policy, of: Policy | None = None, config: CertifyConfig = ASKED, **changes: Any) -> Path:
    """A policy file with the certificate of a policy (its own by default), some values of it changed."""
    of = given if of is None else of
    policies.save(path, given)
    content = certificate.content(of, settings(of), config, proven(of, config))
    files.write_json(certificate.beside(path), {**content, **changes})
    return path
