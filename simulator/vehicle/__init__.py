"""The vehicle as it truly is: airframe, air, sensors and what its estimator makes of them."""
