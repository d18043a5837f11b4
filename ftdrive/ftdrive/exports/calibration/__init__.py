"""A calibration as a file of another program: `formats` lists them, `export` writes one."""
