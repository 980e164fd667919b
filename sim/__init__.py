"""Makes the drone fly and sense: MuJoCo lives here, and only here."""
