"""What a policy perceives: observations, images, IMU samples and the estimate of an estimator."""
