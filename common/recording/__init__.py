"""Recordings of everything on the bus: MCAP files with our schemas inside, read as far as they are whole."""
