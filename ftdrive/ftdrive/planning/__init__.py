"""Plans of how the arm takes the sensor through its poses: reached, clear of itself and of the cell, and priced."""
