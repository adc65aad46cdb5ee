"""Numbers and lists in sentences."""

from sb3_tdc.common.words import count, counted, first_of, listed


def test_one_is_no_plural():
    texts = [count(n, "environment") for n in (0, 1, 2, 1000)]
    assert texts == ["0 environments", "1 environment", "2 environments", "1,000 environments"]


def test_several_numbers():
    assert [counted(numbers, "seed") for numbers in ([1], [1, 5], [2, 3, 5])] == [
        "1 seed",
        "1 and 5 seeds",
        "2, 3 and 5 seeds",
    ]


def test_lists():
    assert [listed(list("abc"[:n])) for n in range(4)] == ["", "a", "a and b", "a, b and c"]


def test_the_first_of_many():
    assert [first_of(list("abcde"[:n])) for n in (1, 3, 4, 5)] == [
        "a",
        "a, b, c",
        "a, b, c and 1 other",
        "a, b, c and 2 others",
    ]
