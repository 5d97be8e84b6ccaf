"""The nodes: parameters and messages in, one call into the core, messages out."""

NODES = (
    'synthetic_camera',
    'measured_camera',
    'detector',
    'rectifier',
    'localizer',
    'rig_localizer',
    'stereo_calibrator',
    'stereo_depth',
    'model_critic',
)
