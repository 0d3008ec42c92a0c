"""Definitions of PX4's messages for bags that do not carry their own (sqlite3 bags up to ROS 2 Humble).

Those of px4_msgs release/1.14. A bag of another release has messages of another length, which then fail to
decode instead of being misread.
"""

from __future__ import annotations

_ATTITUDE = """
uint64 timestamp
uint64 timestamp_sample
float32[4] q
float32[4] delta_q_reset
uint8 quat_reset_counter
"""

_GLOBAL_POSITION = """
uint64 timestamp
uint64 timestamp_sample
float64 lat
float64 lon
float32 alt
float32 alt_ellipsoid
float32 delta_alt
uint8 lat_lon_reset_counter
uint8 alt_reset_counter
float32 eph
float32 epv
float32 terrain_alt
bool terrain_alt_valid
bool dead_reckoning
"""

_SENSOR_GPS = """
uint64 timestamp
uint64 timestamp_sample
uint32 device_id
float64 latitude_deg
float64 longitude_deg
float64 altitude_msl_m
float64 altitude_ellipsoid_m
float32 s_variance_m_s
float32 c_variance_rad
uint8 fix_type
float32 eph
float32 epv
float32 hdop
float32 vdop
int32 noise_per_ms
uint16 automatic_gain_control
uint8 jamming_state
int32 jamming_indicator
uint8 spoofing_state
float32 vel_m_s
float32 vel_n_m_s
float32 vel_e_m_s
float32 vel_d_m_s
float32 cog_rad
bool vel_ned_valid
int32 timestamp_time_relative
uint64 time_utc_usec
uint8 satellites_used
float32 heading
float32 heading_offset
float32 heading_accuracy
float32 rtcm_injection_rate
uint8 selected_rtcm_instance
bool rtcm_crc_failed
uint8 rtcm_msg_used
"""

_ODOMETRY = """
uint64 timestamp
uint64 timestamp_sample
uint8 pose_frame
float32[3] position
float32[4] q
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
float32[3] position_variance
float32[3] orientation_variance
float32[3] velocity_variance
uint8 reset_counter
int8 quality
"""

DEFINITIONS = {
    "px4_msgs/msg/SensorGps": _SENSOR_GPS,
    "px4_msgs/msg/VehicleAttitude": _ATTITUDE,
    "px4_msgs/msg/VehicleGlobalPosition": _GLOBAL_POSITION,
    "px4_msgs/msg/VehicleOdometry": _ODOMETRY,
}
