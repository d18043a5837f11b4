"""An emulated robot cell, which real drivers reach over real wires. It imports no other package of the project."""
