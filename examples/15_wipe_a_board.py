"""Two simulated arms wipe a whiteboard: one holds it, the other wipes. Needs palpate[wipe,sim,vision] and OpenGL.

Takes about half a minute; without a display set MUJOCO_GL=egl.

Prints:
    the other arm holds the board
    pass 1: 1 stroke of 1 straight piece, about 4 s
    clean: 0.0 % of the ink left after 1 pass
    commanded force never above 5 N: True
"""

from palpate import wipe

layer = wipe.InkLayer((0.32, 0.24))
layer.text("hi", (0.06, 0.14), height=0.04)
scene = wipe.BoardScene(layer)


class Listener(wipe.Observer):
    """Told of everything while the job runs; it may pause, resume and stop it, or push the arms."""

    def event(self, event: wipe.Event) -> None:
        if event.kind in ("board", "task", "fault"):
            print(event.text)


options = wipe.JobOptions(speed=0.1, normal_force=2.5, max_force=5.0)
result = wipe.WipeJob(scene, options).run(observer=Listener())
scene.close()

print(f"{result.verdict}: {100.0 * result.ink_left:.1f} % of the ink left after {len(result.passes)} pass")
print("commanded force never above 5 N:", bool(result.track.force.max() <= 5.0 + 1e-9))
