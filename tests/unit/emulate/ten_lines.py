import pytest


def test_half_scale_and_a_chip_that_is_gone(emulated, truth):
    bench = emulated("ad5696r", address=0x0C)
    bus = bench.smbus()  # what your driver takes for an smbus2.SMBus
    bus.write_i2c_block_data(0x0C, 0x31, [0x80, 0x00])
    assert truth(bench, "ad5696r.out0")["ad5696r.out0"] == pytest.approx(2.5, abs=0.001)
    bench.fault("nack", "ad5696r")
    with pytest.raises(OSError, match="no answer"):
        bus.read_byte(0x0C)
