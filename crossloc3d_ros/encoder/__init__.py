"""Patch in, descriptor out: the CrossLoc3D network, its weights and its fast CPU runtime."""
