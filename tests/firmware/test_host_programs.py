"""Programs that take simulated time."""

import pytest
from emulator.site.host_programs import Process

from skyless.core.ticks import from_seconds, to_seconds
from skyless.sim.medium import Timeline


def test_programs_take_turns_in_the_order_of_true_time():
    timeline, said = Timeline(), []

    def program(name, step_s):
        def run():
            for number in range(3):
                processes[name].sleep(step_s)
                said.append((round(to_seconds(timeline.now_ticks), 6), name, number))

        return run

    processes = {name: Process(timeline, program(name, step_s)) for name, step_s in (("a", 0.2), ("b", 0.3))}
    assert list(timeline.run(from_seconds(10.0))) == []
    assert said == [(0.2, "a", 0), (0.3, "b", 0), (0.4, "a", 1), (0.6, "b", 1), (0.6, "a", 2), (0.9, "b", 2)]
    for process in processes.values():
        process.close()


def test_a_program_waits_until_it_is_notified_or_its_time_is_over_and_forgets_nothing():
    timeline, woken = Timeline(), []

    def run():
        for _ in range(4):
            process.wait(1.0)
            woken.append(round(to_seconds(timeline.now_ticks), 6))
            if len(woken) == 2:
                process.sleep(0.5)

    process = Process(timeline, run)
    for at_s in (0.25, 1.5, 1.6):  # the last two while it sleeps: they count once
        timeline.at(from_seconds(at_s), process.notify)
    list(timeline.run(from_seconds(10.0)))
    assert woken == [0.25, 1.25, 1.75, 2.75]
    process.close()


def test_what_a_program_raises_reaches_whoever_runs_the_world_and_a_closed_one_ends_where_it_stands():
    timeline, ended = Timeline(), []

    def broken():
        raise KeyError("broken")

    def endless():
        try:
            while True:
                process.sleep(0.1)
        finally:
            ended.append(timeline.now_ticks)

    process = Process(timeline, endless)
    list(timeline.run(from_seconds(1.05)))
    process.close()
    assert len(ended) == 1
    Process(timeline, broken)
    with pytest.raises(KeyError, match="broken"):
        list(timeline.run(from_seconds(2.0)))
