"""The durable log and the job queue; knows nothing of SLAM."""
