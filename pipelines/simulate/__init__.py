"""Simulation of a survey whose truth is known exactly: scene, flight, sensors and photographs."""
