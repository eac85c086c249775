"""One line of a preflight, for every family."""

from dataclasses import dataclass

__all__ = ["Check"]


@dataclass(frozen=True)
class Check:
    """One line: what was checked, whether it passed, what was seen, what to do. `required` ones stop a run."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = True

    def __str__(self) -> str:
        mark = "pass" if self.ok else ("FAIL" if self.required else "note")
        return f"{mark}  {self.name}: {self.detail}" + ("" if self.ok else f" -> {self.remedy}")
