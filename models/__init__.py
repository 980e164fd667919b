"""Data types that all packages share: states, measurements, calibration, vehicles, and protocols.

The types are frozen dataclasses of numpy arrays. This package neither simulates, estimates nor evaluates.
"""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.models.camera import CameraModel
    from dronevio.models.defects import Defect, DefectKind
    from dronevio.models.errors import (
        ConfigError,
        DronevioError,
        EvaluationError,
        GraphicsError,
        IncompleteError,
        InputError,
    )
    from dronevio.models.image_sets.folder import image_folder
    from dronevio.models.image_sets.image_set import ImageSet
    from dronevio.models.image_sets.open import open_images
    from dronevio.models.image_sets.recording import image_recording
    from dronevio.models.image_sets.video import image_video
    from dronevio.models.imu import ImuModel, ImuSamples
    from dronevio.models.imu_presets import imu_named
    from dronevio.models.protocols import Controller, Estimator, Plant, Recording, measurements
    from dronevio.models.quadrotor import Quadrotor, vehicle_named
    from dronevio.models.reconstruction import Reconstruction
    from dronevio.models.reconstructions.formats import read_reconstruction, write_reconstruction
    from dronevio.models.rig import Rig, RigCamera, euroc_rig
    from dronevio.models.rig_presets import rig_named
    from dronevio.models.rotors import Rotor
    from dronevio.models.state import (
        NO_IMAGE,
        CameraFrame,
        Estimate,
        FeatureTracks,
        Health,
        HealthReport,
        NavState,
        Trajectory,
    )
    from dronevio.models.vehicles.chosen import vehicle_of
    from dronevio.models.vehicles.file import read_vehicle

__all__ = [
    "NO_IMAGE",
    "CameraFrame",
    "CameraModel",
    "ConfigError",
    "Controller",
    "Defect",
    "DefectKind",
    "DronevioError",
    "Estimate",
    "Estimator",
    "EvaluationError",
    "FeatureTracks",
    "GraphicsError",
    "Health",
    "HealthReport",
    "ImageSet",
    "ImuModel",
    "ImuSamples",
    "IncompleteError",
    "InputError",
    "NavState",
    "Plant",
    "Quadrotor",
    "Reconstruction",
    "Recording",
    "Rig",
    "RigCamera",
    "Rotor",
    "Trajectory",
    "euroc_rig",
    "image_folder",
    "image_recording",
    "image_video",
    "imu_named",
    "measurements",
    "open_images",
    "read_reconstruction",
    "read_vehicle",
    "rig_named",
    "vehicle_named",
    "vehicle_of",
    "write_reconstruction",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.models.camera": ("CameraModel",),
        "dronevio.models.defects": ("Defect", "DefectKind"),
        "dronevio.models.errors": (
            "ConfigError",
            "DronevioError",
            "EvaluationError",
            "GraphicsError",
            "IncompleteError",
            "InputError",
        ),
        "dronevio.models.image_sets.folder": ("image_folder",),
        "dronevio.models.image_sets.image_set": ("ImageSet",),
        "dronevio.models.image_sets.open": ("open_images",),
        "dronevio.models.image_sets.recording": ("image_recording",),
        "dronevio.models.image_sets.video": ("image_video",),
        "dronevio.models.imu": ("ImuModel", "ImuSamples"),
        "dronevio.models.imu_presets": ("imu_named",),
        "dronevio.models.protocols": ("Controller", "Estimator", "Plant", "Recording", "measurements"),
        "dronevio.models.quadrotor": ("Quadrotor", "vehicle_named"),
        "dronevio.models.reconstruction": ("Reconstruction",),
        "dronevio.models.reconstructions.formats": ("read_reconstruction", "write_reconstruction"),
        "dronevio.models.rig": ("Rig", "RigCamera", "euroc_rig"),
        "dronevio.models.rig_presets": ("rig_named",),
        "dronevio.models.rotors": ("Rotor",),
        "dronevio.models.state": (
            "NO_IMAGE",
            "CameraFrame",
            "Estimate",
            "FeatureTracks",
            "Health",
            "HealthReport",
            "NavState",
            "Trajectory",
        ),
        "dronevio.models.vehicles.chosen": ("vehicle_of",),
        "dronevio.models.vehicles.file": ("read_vehicle",),
    },
)
