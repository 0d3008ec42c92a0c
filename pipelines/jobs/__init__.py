"""Work in many parts: a job, the engines that run jobs here or on a cluster, batches of missions."""
