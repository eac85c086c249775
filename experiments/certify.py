"""Prove and judge the closed loop of a learned policy: `python -m experiments.certify policy=FILE`."""

import logging
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dqn import policy as policies
from experiments.certification import certificate
from experiments.certification.config import CertifyConfig
from experiments.certification.judge import KINDS, SAFETY, Certificate, certify, worst
from experiments.certification.question import CertificationError, model_of
from experiments.certification.verdict import Proof
from experiments.cli import files, frame
from experiments.cli.calibrated import read_env_file
from experiments.control.policies import SHIPPED, find_policy
from experiments.laws.density.learned import settings
from experiments.reporting.verdict import REMEDY

log = logging.getLogger(__name__)


def body(config: CertifyConfig, folder: Path) -> None:
    """Certify one policy. Raises: frame.UserError if the policy is unreadable, of an unknown kind, or not safe."""
    source = find_policy(config.policy)
    if config.env_file is not None:
        config = replace(config, env=read_env_file(config.env_file), env_file=None)
    to = _place(config, source)
    began = time.perf_counter()
    log.info("proving the closed loop of %s for every reading, setpoint and case, in up to a minute", source)
    with frame.refusing(policies.PolicyError):
        policy = policies.load(source)
    with frame.refusing(ValueError, about=f"policy {source}: "):
        beside = settings(policy, config.estimator)
    with frame.refusing(CertificationError, about=f"policy {source}: "):
        config = replace(config, env=model_of(policy, config))
        found = certify(policy, config)
    log.info("%s: proven in %.1f s", source, time.perf_counter() - began)
    for line in found.lines():
        log.info("%s", line)
    for line in found.cannot_hold():
        log.info("reported, not judged: %s", line)
    unwritten = _write(folder, source, certificate.content(policy, beside, config, found), to, found)
    unsafe, short = (found.failed(kind) for kind in KINDS)
    if unsafe or short:
        log.info("remedy: %s", REMEDY)
    if unsafe:
        of = f"{len(unsafe)} of {sum(check.kind == SAFETY for check in found.checks)} safety requirements fail"
        raise frame.UserError(f"policy {source}: not safe; {of}; the first is {unsafe[0]}")
    if short:
        told = "; ".join(map(str, worst(short)))
        log.warning("policy %s: safe, so a device runs it; performance requirements not met: %s", source, told)
    else:
        log.info("policy %s: safe, and every performance requirement is met", source)
    if unwritten and config.to:  # the user asked for this file
        raise frame.UserError(unwritten)


def _write(folder: Path, source: Path, content: dict[str, Any], to: Path | None, found: Certificate) -> str:
    """Write certificate, copy at `to`, summary, figure and page. Returns: reason why the copy failed, else ""."""
    from experiments.certification.figure import figure
    from experiments.reporting import charts, page
    from experiments.reporting.tensorboard import Events

    files.write_json(folder / "certificate.json", content, indent=None)
    unwritten = ""
    if to is None:
        why = (
            "a quick certificate is not stored beside the policy"
            if found.quick
            else f"{source} is part of the program, whose certificate is kept"
        )
        log.info("the certificate is only in the run folder: %s; to=FILE writes another copy", why)
    else:
        try:
            files.write_json(to, content, indent=None)
            log.info("certificate %s", to)
        except OSError as error:
            unwritten = f"{to}: not written ({error.strerror}); use {folder}/certificate.json, which is identical"
            log.warning("%s", unwritten)
    drawn = charts.save(figure(found), folder / "figures", "certificate")
    files.write_json(folder / "summary.json", _summary(source, content, found))
    with closing(Events(folder)) as events:
        events.picture("figures/certificate", drawn, 0)
        events.text("run/summary", "\n".join(f"- {line}" for line in found.lines()))
    log.info(
        "certificate %s; report %s", folder / "certificate.json", page.save(page.of_runs(folder, [folder]), folder)
    )
    return unwritten


def _place(config: CertifyConfig, source: Path) -> Path | None:
    """Return the path of the certificate's copy outside the run folder, if any. Raises: frame.UserError."""
    if config.to is None:
        own = source.resolve().parent == SHIPPED.resolve().parent
        return None if own or config.quick else certificate.beside(source)
    to = Path(config.to)
    if to.suffix != ".json" or to.is_dir() or not to.parent.is_dir():
        raise frame.UserError(f"to = {to}: allowed a file NAME.json in an existing folder")
    return to


def _summary(source: Path, content: dict[str, Any], found: Certificate) -> dict[str, Any]:
    kept = ("safe", "passed", "of", "observation", "setpoints", "bounds", "checks", "cannot_hold")
    cases = [_row(found.question.loop, proof) for proof in found.proofs if proof.holdable.any()]
    heads = (*content["observation"][:2], "from action", "to action")
    drops = [dict(zip(heads, drop.values(), strict=True)) for drop in content["not_monotone"]]
    told = {"a_higher_reading_gets_a_smaller_dose": drops, "cases": cases}
    return {"policy": str(source), **{key: content[key] for key in kept}, **told}


def _row(loop: Any, proof: Proof) -> dict[str, Any]:
    """Summarise a case over the strips of setpoints that the pump can hold; the OD value is of the middle strip."""
    held = np.flatnonzero(proof.holdable)
    middle = held[np.abs((loop.low + loop.high)[held] / 2.0 - np.mean((loop.low[0], loop.high[-1]))).argmin()]
    return {
        "case": proof.case.name,
        "half-width, least": float(proof.half_width[held].min()),
        "half-width, largest": float(proof.half_width[held].max()),
        "one-line controller, largest": float(proof.law_half_width[held].max()),
        "beyond the one-line controller, largest": float(proof.excess[held].max()),
        "half-width in OD, middle strip": loop.in_od(proof.case, float(proof.half_width[middle])),
        "periods after the one-line controller, largest": float(proof.later[held].max()),
        "periods, largest": float(proof.band.periods[held].max()),
    }


main = frame.EntryPoint("certify", CertifyConfig(), body)


if __name__ == "__main__":
    main()
