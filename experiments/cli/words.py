"""Conversion of command-line arguments to Hydra's form, with error messages for invalid arguments."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from conf import presets
from conf.messages import Message
from experiments.cli import extensions, latest

RUN = "hydra.run.dir="
EXTRA = "pip install 'turbidostat-dqn[sweep]'"


class UserError(Message, Exception):
    """Error that the user can correct. The program shows only its message, one line."""


@contextmanager
def refusing(*errors: type[Exception], about: str = "") -> Iterator[None]:
    """Raise these errors as a UserError in this context. Args: about: prefix of the message."""
    try:
        yield
    except errors as error:
        raise UserError(f"{about}{error}") from None


def _choose(command: str, group: str, option: str) -> None:
    """Check that a command accepts `group=option`. Raises: UserError with the accepted options or the right command."""
    given, own = f"{group}={option}", presets.chosen(command)
    known = presets.groups()[group]
    of = presets.owners(f"{group}/{option}") if option in known else ()
    if of and command not in of:
        what = "recipe" if group == "experiment" else "preset"
        raise UserError(f"{given}: a {what} of {of[0]}; use python -m experiments.{of[0]} +{given}")
    if group not in own:
        others = [name for name in presets.commands() if group in presets.chosen(name)]
        takes = ", ".join(own) or "no group"
        raise UserError(f"{given}: {command} accepts {takes}; {group}= is for {', '.join(others)}")
    if re.fullmatch(r"[\w./-]+", option) and option not in (*known, "null"):
        allowed = ", ".join(presets.options(command, group))
        raise UserError(f"{given}: no such option; allowed: {allowed}")


def normalise(argv: Sequence[str], command: str) -> list[str]:
    """Convert arguments to Hydra's form, independent of the YAML files.

    `group=option` or `+group=option` selects a preset or a user's YAML file. A task selects its agent, unless another
    agent is given. Every other key gets `++`, because the defaults are in the dataclass and not in YAML; the schema
    later refuses unknown keys. `resume=RUN` makes RUN the run folder. `extend=FILE.py` loads the file.
    Raises: UserError for an unknown group or option, with the accepted ones, and for an unusable file.
    """
    with refusing(ValueError):
        _without_key(argv, command)
        argv = [latest.resolved(arg, command) for arg in argv]
        old = resumed(argv)
        if old:
            if others := [arg for arg in argv if arg.startswith("extend=")]:
                raise UserError(f"{others[0]}: not allowed, a resumed run loads {old}/extensions; drop this argument")
            extensions.kept(Path(old))
        argv = [_with_preset_files(arg) for arg in extensions.taken(argv)]
    extensions.offer()
    known = presets.groups()
    out: list[str] = []
    belongs: list[str] = []
    for arg in argv:
        match = re.match(r"^\+?([\w/]+)=(.*)$", arg)
        if match and match[1].startswith("hydra/"):
            arg = f"{match[1]}={_engine(match[1], match[2])}"
        elif match and match[1] in known:
            arg = f"{match[1]}={match[2]}"
            for option in match[2].split(","):
                _choose(command, match[1], option)
            if "," not in match[2] and (other := presets.companion(f"{match[1]}/{match[2]}")):
                belongs += [other] * (other.partition("=")[0] in presets.chosen(command))
        elif re.split("[@=]", arg.lstrip("+"))[0] not in known and not arg.startswith("hydra."):
            arg = re.sub(r"^\+*(?=\w+[^=]*=)", "++", arg)
        out.append(arg)
    chosen = {arg.partition("=")[0] for arg in out}
    out += [other for other in belongs if other.partition("=")[0] not in chosen]
    if old:
        if not (Path(old) / "config.yaml").is_file():
            raise UserError(f"resume={old}: not a run folder (no config.yaml); give the folder of a run")
        out += [f"{RUN}{old}", "hydra.output_subdir=null"]
    return out


def _without_key(argv: Sequence[str], command: str) -> None:
    """Refuse an argument without a key and suggest a key for it. Raises: UserError."""
    key = {"calibrate": "data", "certify": "policy", "deploy": "policy", "score": "policy", "train": "env_file"}
    for before, arg in zip(("", *argv), argv, strict=False):
        if "=" not in arg and arg[:1] not in ("-", "~") and before[:1] != "-":
            named = f"{key.get(command, 'run')}={arg}"
            raise UserError(f"{arg}: give values as KEY=VALUE; did you mean {named}? See --help")


def _with_preset_files(arg: str) -> str:
    """Register each file of `group=FILE.yaml,...` as a preset and return `group=FILE,...`."""
    match = re.match(r"^(\+?([\w/]+)=)(.*\.yaml\b.*)$", arg)
    if match is None or match[2] not in presets.groups():
        return arg
    return match[1] + ",".join(extensions.preset_file(match[2], option) for option in match[3].split(","))


def _engine(group: str, option: str) -> str:
    """Check that a Hydra launcher is installed, and return its name. Raises: UserError with the remedy."""
    needs = {"joblib": "joblib", "submitit_local": "submitit", "submitit_slurm": "submitit", "slurm": "submitit"}
    if group == "hydra/launcher":
        if option not in ("basic", *needs):
            raise UserError(f"{group}={option}: no such option; allowed: basic, {', '.join(needs)}")
        if option != "basic" and find_spec(needs[option]) is None:
            raise UserError(f"{group}={option}: needs hydra-{needs[option]}-launcher; {EXTRA}")
    return option


def resumed(argv: Sequence[str]) -> str | None:
    """Return the run folder that the last `resume=` names, None without one."""
    given = [arg.removeprefix("resume=") for arg in argv if arg.startswith("resume=") and arg != "resume=null"]
    return given[-1] if given else None
