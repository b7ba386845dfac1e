"""Fly in real time, with processes for control, learning and the plant that communicate on a bus."""
