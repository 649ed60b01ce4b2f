"""Simulation of lane fusion over many drives at once, and the wrong ways to fuse."""
