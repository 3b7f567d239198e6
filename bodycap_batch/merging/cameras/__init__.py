"""The path of each camera: outlier removal, and checks of clock, side and stationary cameras."""
