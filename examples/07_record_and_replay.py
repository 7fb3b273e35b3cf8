"""Record a session while it runs, open the recording, run the same pipeline over it: the same bits.

The recording is rosbag2 with standard ROS 2 messages: `ros2 bag play`, PlotJuggler and Foxglove open it. Needs
palpate[sim,logs]. Prints:

    1225 of 1250 samples arrived, 0.250 kg at the end
    replay equals the live run bit for bit: True
"""

from __future__ import annotations

import json

import numpy as np

import palpate as pp
from palpate.drivers.mujoco import MujocoDriver
from palpate.simulate import SensorModel

arm = pp.robots.load("justina_left_arm")
pipeline = pp.Pipeline(arm, observer=pp.MomentumObserver())
controller = pp.Controller(arm, [5, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5], [3.5, 1, 1, 1.5, 1, 1, 1])
motion = pp.Quintic(np.zeros(7), [0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3], duration=3.0)

sensor = SensorModel(arm, loss=0.02, seed=3)  # one sample in fifty is lost, to make it harder
session = {"pipeline": json.dumps(pipeline.options())}
live = []
with (
    MujocoDriver(arm, payload=0.25, sensor=sensor) as driver,
    pp.Recorder("run.mcap", arm.joint_names, session=session, overwrite=True) as recorder,
):
    driver.enable()
    for k in range(5 * 250):
        sample = driver.read()
        if sample is None:
            continue
        recorder.sample(*sample)  # every input, from the first sample on
        touch = pipeline.step(sample)
        live.append([touch.payload.mass, touch.payload.mass_std, *touch.external.torque])
        torque, _ = controller.step(motion.sample(k / 250), touch.q, touch.dq, pipeline.load)
        driver.write(torque)

log = pp.Log.open("run.mcap")
again = pp.Pipeline.from_options(arm, json.loads(log.meta["pipeline"])).run(log)
replayed = np.column_stack([again.payload.mass, again.payload.mass_std, again.external.torque])
print(f"{len(log)} of 1250 samples arrived, {again.payload.mass[-1]:.3f} kg at the end")
print(f"replay equals the live run bit for bit: {np.array_equal(np.array(live), replayed)}")
