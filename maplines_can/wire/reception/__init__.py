"""From received frames to lines: reassembly, checks, the newest line of each slot."""
