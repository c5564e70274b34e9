from torchdof.bench.timer import in_turns, times


def test_turns_go_through_all_works_and_the_first_only_warms_up() -> None:
    calls: list[str] = []
    seconds = in_turns({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2)
    assert calls == ["a", "b"] * 3
    assert {name: len(taken) for name, taken in seconds.items()} == {"a": 2, "b": 2}


def test_one_run_more_warms_up() -> None:
    calls: list[int] = []
    assert len(times(lambda: calls.append(1), 3)) == 3
    assert len(calls) == 4


def test_a_tool_may_tell_its_own_seconds() -> None:
    works = {"slow": lambda: 7.0, "fast": lambda: 0.5}
    assert in_turns(works, 2, seconds_of=lambda work: work()) == {"slow": [7.0] * 2, "fast": [0.5] * 2}
