"""Prove how a learned policy's closed loop behaves, and judge it: `python -m experiments.certify policy=FILE`."""

import logging
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from dqn import policy as policies
from dqn.policy import Policy
from experiments.certification import certificate
from experiments.certification.config import CertifyConfig
from experiments.certification.judge import Certificate, certify
from experiments.certification.question import CertificationError, model_of
from experiments.cli import files, frame
from experiments.cli.calibrated import read_env_file
from experiments.control.policies import find_policy

__all__ = ["main"]

log = logging.getLogger(__name__)


def body(config: CertifyConfig, folder: Path) -> None:
    """Certify one policy. Raises: frame.UserError where it cannot be read or asked, or where it fails."""
    source = find_policy(config.policy)
    if config.env_file is not None:
        config = replace(config, env=read_env_file(config.env_file), env_file=None)
    began = time.perf_counter()
    log.info("proving the closed loop of %s, for every reading, setpoint and case; a minute or less", source)
    with frame.refusing(policies.PolicyError):
        policy = policies.load(source)
    with frame.refusing(CertificationError, about=f"policy {source}: "):
        config = replace(config, env=model_of(policy, config))
        found = certify(policy, config)
    log.info("%s: proven in %.1f s", source, time.perf_counter() - began)
    for check in found.checks:
        log.info("%s  %s", "pass" if check.holds else "FAIL", check)
    for line in found.cannot_hold():
        log.info("said, not judged: %s", line)
    _write(folder, source, policy, config, found)
    if failed := [check for check in found.checks if not check.holds]:
        of = f"{len(failed)} of {len(found.checks)} requirements fail"
        raise frame.UserError(f"policy {source}: not certified, {of}, the first: {failed[0]}")


def _write(folder: Path, source: Path, policy: Policy, config: CertifyConfig, found: Certificate) -> None:
    """The certificate, here and beside the policy; summary, figure and page."""
    from experiments.certification.figure import figure
    from experiments.reporting import charts, page
    from experiments.reporting.tensorboard import Events

    content = certificate.content(policy, config, found)
    files.write_json(folder / "certificate.json", content, indent=None)
    try:
        files.write_json(certificate.beside(source), content, indent=None)
    except OSError as error:
        log.warning("%s: not written (%s); %s/certificate.json is the same", certificate.beside(source),
                    error.strerror, folder)  # fmt: skip
    drawn = charts.save(figure(found), folder / "figures", "certificate")
    files.write_json(folder / "summary.json", _summary(source, content, found))
    with closing(Events(folder)) as events:
        events.picture("figures/certificate", drawn, 0)
        events.text("run/summary", "\n".join(f"- {'pass' if c.holds else 'FAIL'}: {c}" for c in found.checks))
    log.info("certificate %s; report %s", certificate.beside(source), page.save(page.of_runs(folder, [folder]), folder))


def _summary(source: Path, content: dict[str, Any], found: Certificate) -> dict[str, Any]:
    """What a page shows: the verdict, every requirement, and a row per case."""
    kept = ("passed", "fingerprint", "observation", "setpoints", "bounds", "checks", "cannot_hold", "not_monotone")
    cases = [
        {
            "case": proof.case.name,
            "half-width, least": float(proof.half_width.min()),
            "half-width, largest": float(proof.half_width.max()),
            "law, largest": float(proof.law_half_width.max()),
            "entry over physics, largest": float(proof.entry.max()),
            "periods, largest": int(proof.band.periods.max()),
        }
        for proof in found.proofs
    ]
    return {"policy": str(source), **{key: content[key] for key in kept}, "cases": cases}


main = frame.Command("certify", CertifyConfig(), body)


if __name__ == "__main__":
    main()
