"""Robust Instant Policy for Inspect Robots: the policy `rip`, and its simulated tasks, `rip-twin`."""
