"""The budget of a client."""

from flexneedle.lab.page.server.limits import Limits, Rate

LIMITS = Limits(rate=10.0, burst=20.0, excess=2)


def test_a_burst_is_allowed_and_then_the_rate():
    rate = Rate(LIMITS, now=0.0)
    assert sum(rate.allows(0, 0.0) for _ in range(100)) == 20
    assert sum(rate.allows(0, 1.0) for _ in range(100)) == 10
    assert sum(rate.allows(0, 100.0) for _ in range(100)) == 20


def test_long_messages_count_more():
    rate = Rate(LIMITS, now=0.0)
    assert rate.allows(40_000, 0.0)
    assert not rate.allows(40_000, 0.0)
    assert not Rate(LIMITS, now=0.0).allows(80_000, 1000.0)


def test_many_refused_messages_exhaust_it():
    rate = Rate(LIMITS, now=0.0)
    for _ in range(22):
        rate.allows(0, 0.0)
    assert not rate.exhausted
    rate.allows(0, 0.0)
    assert rate.exhausted


def test_the_longest_scenario_file_is_within_the_budget():
    limits = Limits()
    assert Rate(limits, now=0.0).allows(limits.file_bytes, 0.0)
