"""Laser and claw in this process keep their promises."""


def test_the_laser_is_seen_only_while_it_is_lit(cell):
    lit_before = cell.world.laser.at(cell.clock.now())
    with cell.devices.laser.bare.lit():
        lit = cell.world.laser.at(cell.clock.now())
    assert (lit_before, lit, cell.world.laser.at(cell.clock.now())) == (False, True, False)
