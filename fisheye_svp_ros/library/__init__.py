"""The library, `import fisheye_svp_ros as fsvp`: functions on plain objects, and their results."""
