"""What a policy perceives: observations, images, IMU samples and the estimate of an estimator."""

__all__: list[str] = []
