"""Layouts of PX4's messages for bags that do not carry their own definitions (sqlite3 bags up to ROS 2 Humble).

After `msg/*.msg` of PX4-Autopilot and px4_msgs. Fields changed between releases. The length of a message reveals
its layout, together with the distance of `timestamp_sample` from `timestamp`.
"""

from __future__ import annotations

_ATTITUDE = """
uint64 timestamp
{sample}
float32[4] q
float32[4] delta_q_reset
uint8 quat_reset_counter
"""

_GLOBAL_POSITION_1_11 = """
uint64 timestamp
float64 lat
float64 lon
float32 alt
float32 alt_ellipsoid
float32 delta_alt
uint8 lat_lon_reset_counter
uint8 alt_reset_counter
float32 vel_n
float32 vel_e
float32 vel_d
float32 yaw
float32 eph
float32 epv
float32 terrain_alt
bool terrain_alt_valid
bool dead_reckoning
"""

_GLOBAL_POSITION_1_14 = """
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

_GLOBAL_POSITION_1_16 = """
uint64 timestamp
uint64 timestamp_sample
float64 lat
float64 lon
float32 alt
float32 alt_ellipsoid
bool lat_lon_valid
bool alt_valid
float32 delta_alt
float32 delta_terrain
uint8 lat_lon_reset_counter
uint8 alt_reset_counter
uint8 terrain_reset_counter
float32 eph
float32 epv
float32 terrain_alt
bool terrain_alt_valid
bool dead_reckoning
"""

_GPS = """
uint64 timestamp
uint64 timestamp_sample
uint32 device_id
{place}
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
{authentication}
float32 vel_m_s
float32 vel_n_m_s
float32 vel_e_m_s
float32 vel_d_m_s
float32 cog_rad
bool vel_ned_valid
int32 timestamp_time_relative
uint64 time_utc_usec
uint8 satellites_used
{error}
float32 heading
float32 heading_offset
float32 heading_accuracy
float32 rtcm_injection_rate
uint8 selected_rtcm_instance
{tail}
"""

_WHOLE = "int32 lat\nint32 lon\nint32 alt\nint32 alt_ellipsoid"
_DEGREES = "float64 latitude_deg\nfloat64 longitude_deg\nfloat64 altitude_msl_m\nfloat64 altitude_ellipsoid_m"
_RTCM = "bool rtcm_crc_failed\nuint8 rtcm_msg_used"
_QUALITY = "\n".join(
    f"uint8 quality_{name}" for name in ("corrections", "receiver", "gnss_signals", "post_processing")
)
_ANTENNA = "\n".join(f"float32 antenna_offset_{axis}" for axis in "xyz")
_SINCE_1_16 = {"place": _DEGREES, "authentication": "uint8 authentication_state", "error": "uint32 system_error"}

_ODOMETRY_OLD = """
uint64 timestamp
{sample}
uint8 local_frame
float32 x
float32 y
float32 z
float32[4] q
float32[4] q_offset
float32[21] pose_covariance
{velocity_frame}
float32 vx
float32 vy
float32 vz
float32 rollspeed
float32 pitchspeed
float32 yawspeed
float32[21] velocity_covariance
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

_SAMPLE = "uint64 timestamp_sample"

# Layouts of each message from the newest to the oldest, by the release in which the layout first appeared.
DEFINITIONS: dict[str, dict[str, str]] = {
    "px4_msgs/msg/SensorGps": {
        "1.17": _GPS.format(**_SINCE_1_16, tail=f"{_RTCM}\n{_ANTENNA}"),
        "1.16 with quality": _GPS.format(**_SINCE_1_16, tail=f"{_RTCM}\n{_QUALITY}"),
        "1.16": _GPS.format(**_SINCE_1_16, tail=_RTCM),
        "1.15": _GPS.format(place=_DEGREES, authentication="", error="", tail=_RTCM),
        "1.14": _GPS.format(place=_WHOLE, authentication="", error="", tail=""),
    },
    "px4_msgs/msg/VehicleAttitude": {
        "1.14": _ATTITUDE.format(sample=_SAMPLE),
        "1.11": _ATTITUDE.format(sample=""),
    },
    "px4_msgs/msg/VehicleGlobalPosition": {
        "1.16": _GLOBAL_POSITION_1_16,
        "1.14": _GLOBAL_POSITION_1_14,
        "1.11": _GLOBAL_POSITION_1_11,
    },
    "px4_msgs/msg/VehicleOdometry": {
        "1.14": _ODOMETRY,
        "1.12": _ODOMETRY_OLD.format(sample=_SAMPLE, velocity_frame="uint8 velocity_frame"),
        "1.11": _ODOMETRY_OLD.format(sample="", velocity_frame=""),
    },
}
