"""Makes the drone fly and sense: MuJoCo lives here, and only here."""

from dronevio.sim.cameras.gl import choose_backend

choose_backend()  # before anything here imports MuJoCo, which reads the choice once
