"""Prediction of a run before anything is rendered: its recording, its H, and the error that they leave."""
