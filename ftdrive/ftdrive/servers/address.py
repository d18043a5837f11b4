"""Host and port in options and on screen."""

import ipaddress

from ftdrive.errors import ConfigError


def host_and_port(option: str, text: str, example: str, *, lowest: int = 1) -> tuple[str, int]:
    """Read HOST:PORT, with brackets round an IPv6 address; raises `ConfigError`."""
    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or not lowest <= int(port) < 65536:
        raise ConfigError(f"{option} is '{text}': give HOST:PORT, such as {example}")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether only this computer reaches an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def with_port(host: str, port: int) -> str:
    """Write HOST:PORT, with brackets round an IPv6 address."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
