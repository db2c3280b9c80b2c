"""Conversion between the torques of the interfaces (N·mm) and of the kernel (mN·mm)."""

MILLINEWTON_PER_NEWTON = 1000.0
