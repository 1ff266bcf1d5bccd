"""Two programs that tell one thing at once are told from one that takes over, and from a relay."""

from echogrid.live.senders import AT_ONCE_S, MOST, TURNS, Senders


def heard(sources, stamps=None):
    senders = Senders()
    for number, source in enumerate(sources):
        senders.note("/odom", source, stamps[number] if stamps else 0.1 * number, 0.1 * number)
    return senders


def test_two_in_turn_are_at_odds_and_told_for_good():
    senders = heard("ab" * (TURNS + 1))
    assert senders.contested == ["/odom"]
    last = 0.1 * (2 * TURNS + 1)
    assert senders.at_odds(last)
    assert not senders.at_odds(last + AT_ONCE_S)
    assert senders.contested == ["/odom"]


def test_one_that_takes_over_is_not_nor_one_that_hands_back():
    assert heard("aaaabbbb").contested == []
    assert heard("aaaabbbbaaaa").contested == []
    assert not heard("aaaabbbb").at_odds(0.8)


def test_a_relay_repeats_what_was_said_however_late():
    at_once = heard("ab" * 10, [0.1 * (n // 2) for n in range(20)])
    later = heard("aaa" + "ba" * 10, [0.0, 0.1, 0.2, *(0.1 * (n // 2 + 3 * (n % 2)) for n in range(20))])
    assert at_once.contested == later.contested == []


def test_who_is_not_known_is_nobody_and_what_is_kept_is_bounded():
    assert heard([None, "a"] * 10).contested == []
    senders = Senders()
    for number in range(2 * MOST):
        senders.note(f"/s{number}", "a", 0.0, 0.0)
    assert len(senders._last) == len(senders._stamps) == MOST
