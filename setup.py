"""The package for pip and for colcon (ament_python)."""

import sys
from pathlib import Path

from setuptools import find_packages, setup

package_name = 'fisheye_svp_ros'
share = f'share/{package_name}'
nodes = (
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

# colcon installs by these commands, into lib/ of a workspace, where `ros2 run` looks; pip makes
# wheels.  There, names such as `detector` would be on the path of everybody, and `fisheye-svp`
# would be there twice.
for_colcon = not {'install', 'develop'}.isdisjoint(sys.argv)
wheels = "sys_platform == 'linux' and platform_machine == 'x86_64' and python_version < '3.15'"


def tree(folder):
    """Return data_files entries that keep a folder's layout below share/."""
    files = sorted(path for path in Path(folder).rglob('*') if path.is_file())
    return [(f'{share}/{path.parent}', [str(path)]) for path in files]


setup(
    name=package_name,
    version='1.1.0',
    packages=find_packages(include=[package_name, f'{package_name}.*']),
    package_data={
        package_name: ['py.typed', '*.pyi'],
        f'{package_name}.reporting': ['templates/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (share, ['package.xml']),
        # setup.cfg sends the scripts to lib/, off the path.
        *([('bin', ['resource/fisheye-svp'])] if for_colcon else []),
        *tree('config'),
        *tree('launch'),
    ],
    python_requires='>=3.11',
    install_requires=[
        'setuptools',
        'numpy>=1.26',
        'scipy>=1.11',
        'pandas>=2.1',
        'PyYAML>=6.0',
        'matplotlib>=3.6',
        'rich>=13.0',
        'Jinja2>=3.1',
        'opencv-python-headless>=4.6',
        'rosbags>=0.11.9',
        'mcap>=1.1',
        'lz4>=3.1',
        'zstandard>=0.17',
        'threadpoolctl>=3.2',
    ],
    extras_require={
        # Genuine ROS 2 Jazzy, where there are wheels of it; elsewhere an installation is sourced.
        'ros': [
            f'{package}; {wheels}'
            for package in (
                'ros-jazzy-rclpy[fastrtps]>=7.1.6,<7.2',
                'ros-jazzy-common-interfaces>=5.3.6,<5.4',
                'ros-jazzy-std-srvs>=5.3.6,<5.4',
            )
        ],
        'fast': ['numba>=0.59'],
        'parquet': ['pyarrow>=15'],
        'dask': ['distributed>=2023.7'],
        'test': [
            # pytest-xdist 3.8 does not see its groups in pytest 9.2.
            'pytest>=7.4,<9.2',
            'pytest-xdist>=3.3',
            'mpmath>=1.3',
            'psutil>=5.9',
            'hypothesis>=6.80',
            'pytest-cov>=4.1',
            'jsonschema>=4.10',
            'statsmodels>=0.14',
            'pytest-rerunfailures>=12.0',
        ],
        'docs': ['sphinx>=7.2', 'myst-parser>=2.0', 'furo'],
        # mypy takes the types of NumPy 2.5, which are written for Python 3.12, for others.
        'lint': [
            'numpy<2.5',
            'ruff==0.17.*',
            'mypy>=1.11',
            'import-linter>=2.17',
            'types-PyYAML',
            'scipy-stubs',
        ],
    },
    zip_safe=True,
    maintainer='fisheye_svp_ros maintainers',
    description='What the single-viewpoint approximation of a fisheye lens costs, and what a '
    'simulation gets wrong about measured image points.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            f'fisheye-svp = {package_name}.cli:main',
            *(f'{node} = {package_name}.nodes.executables:{node}' for node in nodes if for_colcon),
        ],
    },
)
