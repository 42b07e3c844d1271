"""What is said of a name that does not exist."""

import pytest

from scenes.names import FEW, MANY, unknown


def test_of_many_names_only_the_likest_are_told():
    have = [f"veh_{i}" for i in range(MANY + 80)]
    said = unknown("actor", "veh_130", "s1", have)
    assert said.startswith('actor "veh_130" is not in s1; it has 100, the closest of which are ')
    told = said.split(" are ")[1].split(".")[0].split(", ")
    assert len(told) == FEW and {"veh_13", "veh_30"} <= set(told)
    assert said.endswith("Did you mean veh_10?")


def test_of_few_names_all_are_told_in_their_order():
    have = [f"veh_{i}" for i in range(MANY)]
    assert f"it has {', '.join(have)}." in unknown("actor", "veh_99", "s1", have)


@pytest.mark.parametrize(("name", "each"), [("a,b", None), ("ab,", "--remove {}"), ("ab", "--remove {}")])
def test_an_option_is_said_to_repeat_only_where_it_does_and_several_are_named(name, each):
    assert "repeat" in unknown("actor", "a,b", "s1", ["a", "b"], "--remove {}")
    assert "repeat" not in unknown("actor", name, "s1", ["a", "b"], each)
