"""`turbopi replay`: a policy over recorded episodes, its chunks beside the actions that were recorded.

episodes.py         what every kind of dataset gives: episodes, and moments of them
opening.py          which kind a path is
lerobot_dataset.py  LeRobotDataset v2.0, v2.1 and v3.0, read with pyarrow; video.py: their videos, with PyAV
episode_files.py    a folder of .npz or .hdf5 episodes
recorded_calls.py   what `turbopi serve --record` wrote
keys.py             a dataset's keys to the robot's
run.py              which moments, and the policy on each of them
compare.py          errors and controls; judge.py: what they say
report.py           the report: document.py, plots.py, page.py
"""
