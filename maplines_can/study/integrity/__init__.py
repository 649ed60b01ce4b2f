"""Verification of protection levels: importance sampling of rare errors, Stanford diagram."""
