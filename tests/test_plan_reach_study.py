"""The study of plans that miss: which worlds it lists, and the share that it prints."""

from plan_reach import Found, is_reached, main, plan_world, summary, table

REACHED = Found("wide:1", True, (0.05, ""), (0.05, ""))
FOUND_LATER = Found("wide:2", True, (0.3, ""), (0.02, ""))
REFUSED = Found("wide:3", False, (0.01, "needle strain 1.2 % > 1 %"), (0.02, "needle strain 1.1 % > 1 %"))


def test_a_plan_reaches_that_ends_near_its_target_and_passes_the_guard():
    assert [is_reached(one.usual) for one in (REACHED, FOUND_LATER, REFUSED)] == [True, False, False]


def test_worlds_that_are_not_reached_are_listed_and_the_reachable_ones_counted():
    found = [REACHED, FOUND_LATER, REFUSED]
    assert table(found).splitlines()[2:] == [
        "| wide:2 | yes | 0.30  | 0.02  |",
        "| wide:3 | no | 0.01 needle strain 1.2 % > 1 % | 0.02 needle strain 1.1 % > 1 % |",
    ]
    assert summary(found) == "1 of 2 plans reach that either search reaches; 3 worlds"


def test_only_a_plan_that_misses_is_searched_again():
    """Below the skin of wide:25, which has no guide, the bevel's reach ends 0.46 mm before the target."""
    missed, met = (plan_world("wide", "manipulation", 1, number) for number in (25, 0))
    assert not is_reached(missed.usual)
    assert missed.usual == missed.large  # the same search, since its size is the same
    assert is_reached(met.usual)


def test_a_world_is_planned_and_summed_up(capsys):
    assert main(["--worlds", "0", "1", "--workers", "1"]) == 0
    assert capsys.readouterr().out.endswith("1 of 1 plans reach that either search reaches; 1 worlds\n")
