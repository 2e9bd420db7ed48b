"""What is sent to a device, drawn there, and brought back."""

import numpy as np
import pytest
import torch

from ecslam.sending import TURNS, Dice, Letter, Since

CPU = torch.device("cpu")


def test_a_letter_arrives_whole_and_always_in_the_same_place():
    letter = Letter(19, CPU)
    place = letter.there.data_ptr()
    for gain in range(2 * TURNS):
        arrived = letter.send(np.eye(4, dtype=np.float32), (1, 2), gain, [])
        assert arrived.data_ptr() == letter.there.data_ptr() == place
        assert arrived.tolist() == [*np.eye(4).ravel(), 1, 2, gain]


def test_a_letter_of_another_length_is_refused():
    with pytest.raises(ValueError, match="shape"):
        Letter(5, CPU).send(np.eye(4))


def test_what_was_sent_before_may_still_be_on_its_way():
    letter = Letter(1, CPU)
    written = []
    for number in range(TURNS):
        letter.send(number)
        written.append(letter._turns[0][0])
    assert [float(turn) for turn in written] == list(range(TURNS))


def test_dice_show_other_numbers_each_time_and_the_same_for_the_same_seed():
    def thrown():
        dice = Dice(5, torch.Generator().manual_seed(3))
        places, rows = set(), []
        for _ in range(3 * Dice.ROWS):
            rows.append(dice.rows[dice.throw()].clone())
            places.add(dice.rows.data_ptr())
        assert len(places) == 1
        return torch.stack(rows)

    one = thrown()
    assert torch.equal(one, thrown())
    assert len(one.unique()) > 0.99 * one.numel()
    assert ((one >= 0) & (one < 1)).all()


def test_a_result_is_there_at_once_on_a_cpu():
    since = Since(CPU)
    brought = since.bring(torch.arange(3.0))
    assert since.done()
    assert since.seconds() >= 0
    assert brought.tolist() == [0, 1, 2]
