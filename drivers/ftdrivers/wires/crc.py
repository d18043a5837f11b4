"""The two checksums of the serial protocols. Both are reflected, start at 0xFFFF and are sent low byte first."""


def _table(polynomial: int) -> tuple[int, ...]:
    def entry(byte: int) -> int:
        for _ in range(8):
            byte = byte >> 1 ^ (polynomial if byte & 1 else 0)
        return byte

    return tuple(entry(byte) for byte in range(256))


_MODBUS, _X25 = _table(0xA001), _table(0x8408)


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS; of ``b"123456789"`` it is 0x4B37."""
    return _crc(data, _MODBUS)


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25; of ``b"123456789"`` it is 0x906E."""
    return _crc(data, _X25) ^ 0xFFFF


def _crc(data: bytes, table: tuple[int, ...]) -> int:
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
    return crc
