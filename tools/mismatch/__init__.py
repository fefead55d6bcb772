"""Where a simulation and a recording differ: which physics was left out, and what modelling it gains.

What lives here: recordings of the contract, twins, the engine that decides, reports, the blind proof.
What must not: physics of its own; effects are in ``sim_devices.physics``, and ``prove`` shares none of them.
"""
