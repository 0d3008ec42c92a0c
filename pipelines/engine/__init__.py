"""Engine: commands of this program as jobs, several at a time, for work that consists of many parts."""
