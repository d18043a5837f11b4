"""Adapters for arms and force/torque sensors behind two abstract interfaces."""
