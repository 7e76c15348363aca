"""Logs of other programs, written from a table of a flight, to be read back.

A table has the columns t (s), ``share`` 1 to 4 of the stack's motors, ``gyro`` x to z (rad/s),
``acc`` x to z (m/s²), body axes x forward, y left, z up.
"""

import struct

import numpy as np

GYRO = ["gyro_x", "gyro_y", "gyro_z"]
ACC = ["acc_x", "acc_y", "acc_z"]
SHARES = ["share_1", "share_2", "share_3", "share_4"]
FLIP = np.array([1.0, -1.0, -1.0])


def write_ulog(path, table):
    """PX4's ULog with vehicle_angular_velocity, vehicle_acceleration and actuator_motors."""
    formats = {
        "vehicle_angular_velocity": "uint64_t timestamp;float[3] xyz;",
        "vehicle_acceleration": "uint64_t timestamp;float[3] xyz;",
        "actuator_motors": "uint64_t timestamp;float[4] control;",
    }

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    parts += [message("F", f"{name}:{fields}".encode()) for name, fields in formats.items()]
    for number, name in enumerate(formats):
        parts.append(message("A", struct.pack("<BH", 0, number) + name.encode()))
    arrays = (table[GYRO] * FLIP, table[ACC] * FLIP, table[SHARES])
    arrays = [values.to_numpy() for values in arrays]
    for row, time in enumerate(table["t"]):
        for number, values in enumerate(arrays):
            numbers = values[row]
            stamp = struct.pack("<HQ", number, round(1e6 * time))
            parts.append(message("D", stamp + struct.pack(f"<{len(numbers)}f", *numbers)))
    path.write_bytes(b"".join(parts))


def _variable(number):
    """A whole number as Betaflight's signed variable bytes."""
    zigzag = (number << 1) ^ (number >> 31)
    zigzag &= 0xFFFFFFFF
    found = bytearray()
    while zigzag > 127:
        found.append((zigzag & 127) | 128)
        zigzag >>= 7
    return bytes([*found, zigzag])


def write_blackbox(path, table):
    """A blackbox log that consists of I frames alone, each field as it is."""
    names = ["loopIteration", "time"]
    for name, count in (("gyroADC", 3), ("accSmooth", 3), ("motor", 4)):
        names += [f"{name}[{k}]" for k in range(count)]
    many = len(names)
    headers = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock",
        "Data version": "2",
        "I interval": "1",
        "P interval": "1/1",
        "Field I name": ",".join(names),
        "Field I signed": ",".join("1" * many),
        "Field I predictor": ",".join("0" * many),
        "Field I encoding": ",".join("0" * many),
        "Field P predictor": ",".join("0" * many),
        "Field P encoding": ",".join("0" * many),
        "acc_1G": "2048",
        "gyro_scale": "0x3f800000",
        "motorOutput": "158,2047",
        "minthrottle": "1070",
        "maxthrottle": "2000",
        "vbatref": "1600",
    }
    parts = ["".join(f"H {name}:{value}\n" for name, value in headers.items()).encode()]
    columns = [np.arange(len(table)), 1e6 * table["t"]]
    columns += [np.degrees(table[name]) for name in GYRO]
    columns += [table[name] / 9.80665 * 2048 for name in ACC]
    columns += [48 + 1999 * table[name] for name in SHARES]
    for row in np.round(np.stack(columns, axis=1)).astype(int).tolist():
        parts.append(b"I" + b"".join(map(_variable, row)))
    parts.append(b"E\xffEnd of log\0")
    path.write_bytes(b"".join(parts))


def write_usd(path, table):
    """The log of a Crazyflie's µSD card, as tools/usdlog of its firmware has it."""
    names = [f"acc.{k}(f)" for k in "xyz"] + [f"gyro.{k}(f)" for k in "xyz"]
    names += [f"motor.m{k}(I)" for k in (1, 2, 3, 4)]
    parts = [struct.pack("<BHHH", 0xBC, 2, 1, 0xFFFF), b"fixedFrequency\0"]
    parts += [struct.pack("<H", len(names)), *(name.encode() + b"\0" for name in names)]
    floats = np.hstack([table[ACC] / 9.80665, np.degrees(table[GYRO])])
    motors = np.round(65535 * table[SHARES].to_numpy()).astype(int)
    for time, row, shares in zip(table["t"], floats, motors, strict=True):
        parts.append(struct.pack("<HQ6f4I", 0xFFFF, round(1e6 * time), *row, *shares))
    path.write_bytes(b"".join(parts) + bytes(4))


def write_plain(path, table):
    """The plain CSV file."""
    names = {name: name.replace("share_", "command_m") for name in SHARES}
    table.rename(columns=names).to_csv(path, index=False)
