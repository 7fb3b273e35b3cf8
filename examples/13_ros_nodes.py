"""A ROS 2 graph without ROS: six nodes let a simulated arm lift something and weigh it. Needs palpate[sim,ros].

Prints:
    joint_states: 751 messages of 7 joints
    nodes: arm_simulation, control, extended_kalman_filter, listener, mass, sliding_mode_observer, trajectory
    the graph says 250 g, with a standard deviation below 1 g
"""

import math
import os

from palpate.ros import Context, Node
from palpate.ros.launch import Launch, graph
from palpate.ros.messages import Float64, JointState

domain = 1 + os.getpid() % 100  # so that this example meets no other; on a robot: nothing, or ROS_DOMAIN_ID
simulation = {"pace": 0.0, "duration": 3.0, "seed": 1, "wait_for": 5}  # at full pace; five read
arguments = ["--ros-args"]
for name, value in simulation.items():
    arguments += ["-p", f"arm_simulation:{name}:={value}"]

states, masses, spreads, nodes = [], [], [], []
with Context(domain, localhost=True) as there, Node("listener", there, quiet=True) as node:
    node.subscribe(JointState, "joint_states", lambda message, writer: states.append(message))
    node.subscribe(Float64, "payload_mass", lambda message, writer: masses.append(message.data))
    node.subscribe(Float64, "payload_mass_std", lambda message, writer: spreads.append(message.data))
    launched = Launch(
        graph("mass-estimation"), arguments, ["--domain", str(domain), "--localhost", "--quiet"]
    )
    launched.start()
    try:
        node.spin_until(lambda: len(there.nodes()) == 7, timeout=100.0)
        nodes = there.nodes()
        node.spin_until(lambda: len(masses) >= 751, timeout=100.0)
    finally:
        launched.stop()

print(f"joint_states: {len(states)} messages of {len(states[0].name)} joints")
print("nodes:", ", ".join(name.removeprefix("/") for name in nodes))
known = [mass for mass in masses if math.isfinite(mass)]  # what is not to be used is published as NaN
print(
    f"the graph says {1000 * known[-1]:.0f} g, with a standard deviation below {math.ceil(1000 * spreads[-1])} g"
)
