"""The solver core: from poses and wrenches to a calibration. Pure: numpy and scipy, no device."""
