"""The packets that other tests read are a sensor's: a decoder finds each point where it was put."""

import lidar_packets as packets
import numpy as np
import pytest
import velodyne_decoder

NUM_POINTS = 20_000
SENSORS = {"VLP-16": packets.VLP16, "HDL-32E": packets.HDL32E, "HDL-64E": packets.HDL64E}


@pytest.mark.parametrize("name", SENSORS)
def test_a_decoder_gives_the_points_back(tmp_path, name):
    sensor = SENSORS[name]
    num_lasers = len(sensor.elevation_deg)
    rng = np.random.default_rng(0)
    firing, laser = np.divmod(rng.permutation(sensor.num_firings * num_lasers)[:NUM_POINTS], num_lasers)
    azimuth = -2 * np.pi * firing / sensor.num_firings
    elevation = np.radians(sensor.elevation_deg)[laser]
    distance_m = rng.uniform(2, 80, NUM_POINTS)
    strength = rng.integers(1, 256, NUM_POINTS)
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    xyz = distance_m[:, None] * np.stack(rays, axis=1)
    packets.write_pcap(tmp_path / "a.pcap", packets.sweep_packets(sensor, xyz, strength / 255))

    config = velodyne_decoder.Config()
    if sensor is packets.HDL64E:
        # Its lasers differ from unit to unit; other models are told by the packets.
        calibration = velodyne_decoder.Calibration.from_string(packets.hdl64e_calibration())
        config = velodyne_decoder.Config(model=velodyne_decoder.Model.HDL64E_S3, calibration=calibration)
    ((stamp, decoded),) = velodyne_decoder.read_pcap(str(tmp_path / "a.pcap"), config)

    assert stamp.host == pytest.approx(packets.START_S + packets.TURN_S, abs=0.002)
    assert stamp.device == pytest.approx(stamp.host, abs=2e-6)
    x, y, z, intensity, time_s, column, ring, _ = decoded[np.lexsort((decoded[:, 6], decoded[:, 5]))].T
    rank = np.argsort(np.argsort(sensor.elevation_deg))[laser]
    order = np.lexsort((rank, firing))
    np.testing.assert_array_equal(column, firing[order])
    np.testing.assert_array_equal(ring, rank[order])
    np.testing.assert_array_equal(intensity, strength[order])
    # It knows how high above the optical centre each laser of the VLP-16 and the HDL-32E sits: centimetres.
    bound_m = packets.DISTANCE_STEP_M / 2 + 1e-4 if sensor is packets.HDL64E else 0.03
    np.testing.assert_allclose(np.hypot(np.hypot(x, y), z), distance_m[order], atol=bound_m)
    np.testing.assert_allclose(z, xyz[order, 2], atol=bound_m)
    # Lasers fire one after the other, while the sensor turns on.
    late = (azimuth[order] - np.arctan2(y, x)) % (2 * np.pi) * sensor.num_firings / (2 * np.pi)
    assert np.all((late < 1) | (late > sensor.num_firings - 0.05))
    turned_s = packets.TURN_S * firing[order] / sensor.num_firings
    np.testing.assert_allclose(time_s - time_s.min(), turned_s, atol=0.001)
