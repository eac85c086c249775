"""The table of bugs written by hand counts what its file says."""

from tests.mutants.by_hand import noticed


def test_noticed_of_written_by_room_and_list() -> None:
    def bugs(room: str, k: int, seen: int, unseen: int) -> list[dict[str, object]]:
        return [{"room": room, "list": k, "noticed": i < seen} for i in range(seen + unseen)]

    found = noticed(bugs("envs", 1, 2, 3) + bugs("cli", 1, 0, 1) + bugs("cli", 2, 4, 0))
    assert found == [["envs", "2 of 5", "0 of 0"], ["cli", "0 of 1", "4 of 4"], ["all", "2 of 6", "4 of 4"]]
