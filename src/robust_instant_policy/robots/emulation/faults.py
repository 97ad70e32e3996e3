"""Faults that an emulated device can be told to have."""

import random
import threading

from robust_instant_policy.errors import UnknownNameError

FAULTS = {
    "unplugged": "the cable is pulled out",
    "silent": "the device answers nothing",
    "garbled": "one answer in 200 has a wrong byte",
    "frozen": "the device repeats its last state",
    "overload": "the device reports an overload and stops",
    "protective-stop": "the safety system stops the arm",
    "blocked": "a joint does not move any more",
    "nan": "measured positions are not numbers",
}


GARBLED_SHARE = 1 / 200


class FaultSwitch:
    """The fault that a device has now; empty for none."""

    def __init__(self) -> None:
        self._lock, self._fault = threading.Lock(), ""
        self._random = random.Random(0)

    def set(self, fault: str) -> None:
        """Raises `UnknownNameError` for a fault that no device has."""
        if fault and fault not in FAULTS:
            raise UnknownNameError("fault", fault, FAULTS)
        with self._lock:
            self._fault = fault

    def __call__(self, fault: str) -> bool:
        return self._fault == fault

    def garble(self, packet: bytes) -> bytes:
        """``packet``, with one byte inverted now and then where the device is garbled."""
        if self._fault != "garbled" or self._random.random() > GARBLED_SHARE:
            return packet
        at = self._random.randrange(len(packet))
        return packet[:at] + bytes([packet[at] ^ 0xFF]) + packet[at + 1 :]
