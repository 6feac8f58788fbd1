"""Assistance: a robot arm helps a seated person with one of four tasks, on MuJoCo MJX."""
