"""Layouts of PX4's messages, for bags without definitions: sqlite3 bags up to ROS 2 Humble carry none.

The layouts are after `msg/*.msg` of PX4-Autopilot and px4_msgs. Fields changed between releases. The length of a
message reveals its layout, together with the distance of `timestamp_sample` from `timestamp`.
"""


def _layout(*parts: str) -> str:
    """Return a definition in ROS's message language: of each type and its names, a line a name."""
    lines = [line.split() for part in parts for line in part.splitlines()]
    return "".join(f"{line[0]} {name}\n" for line in lines for name in line[1:])


_NO_SAMPLE, _SAMPLE = "uint64 timestamp", "uint64 timestamp timestamp_sample"
_ATTITUDE = """
float32[4] q delta_q_reset
uint8 quat_reset_counter"""
_POSITION = """
float64 lat lon
float32 alt alt_ellipsoid delta_alt
uint8 lat_lon_reset_counter alt_reset_counter"""
_POSITION_1_16 = """
float64 lat lon
float32 alt alt_ellipsoid
bool lat_lon_valid alt_valid
float32 delta_alt delta_terrain
uint8 lat_lon_reset_counter alt_reset_counter terrain_reset_counter"""
_ERRORS = """
float32 eph epv terrain_alt
bool terrain_alt_valid dead_reckoning"""
_GPS = """
float32 s_variance_m_s c_variance_rad
uint8 fix_type
float32 eph epv hdop vdop
int32 noise_per_ms
uint16 automatic_gain_control
uint8 jamming_state
int32 jamming_indicator
uint8 spoofing_state"""
_VELOCITY = """
float32 vel_m_s vel_n_m_s vel_e_m_s vel_d_m_s cog_rad
bool vel_ned_valid
int32 timestamp_time_relative
uint64 time_utc_usec
uint8 satellites_used"""
_HEADING = """
float32 heading heading_offset heading_accuracy rtcm_injection_rate
uint8 selected_rtcm_instance"""
_WHOLE = "uint32 device_id\nint32 lat lon alt alt_ellipsoid"
_DEGREES = "uint32 device_id\nfloat64 latitude_deg longitude_deg altitude_msl_m altitude_ellipsoid_m"
_RTCM = "bool rtcm_crc_failed\nuint8 rtcm_msg_used"
_QUALITY = "uint8 quality_corrections quality_receiver quality_gnss_signals quality_post_processing"
_ANTENNA = "float32 antenna_offset_x antenna_offset_y antenna_offset_z"
_AUTHENTICATION, _SYSTEM_ERROR = "uint8 authentication_state", "uint32 system_error"
_GPS_1_16 = (_SAMPLE, _DEGREES, _GPS, _AUTHENTICATION, _VELOCITY, _SYSTEM_ERROR, _HEADING, _RTCM)
_ODOMETRY = """
uint8 pose_frame
float32[3] position
float32[4] q
uint8 velocity_frame
float32[3] velocity angular_velocity position_variance orientation_variance velocity_variance
uint8 reset_counter
int8 quality"""
_OLD_POSE = """
uint8 local_frame
float32 x y z
float32[4] q q_offset
float32[21] pose_covariance"""
_OLD_VELOCITY = """
float32 vx vy vz rollspeed pitchspeed yawspeed
float32[21] velocity_covariance"""

# Layouts of each message from the newest to the oldest, by the release in which the layout first appeared.
DEFINITIONS: dict[str, dict[str, str]] = {
    "px4_msgs/msg/SensorGps": {
        "1.17": _layout(*_GPS_1_16, _ANTENNA),
        "1.16 with quality": _layout(*_GPS_1_16, _QUALITY),
        "1.16": _layout(*_GPS_1_16),
        "1.15": _layout(_SAMPLE, _DEGREES, _GPS, _VELOCITY, _HEADING, _RTCM),
        "1.14": _layout(_SAMPLE, _WHOLE, _GPS, _VELOCITY, _HEADING),
    },
    "px4_msgs/msg/VehicleAttitude": {
        "1.14": _layout(_SAMPLE, _ATTITUDE),
        "1.11": _layout(_NO_SAMPLE, _ATTITUDE),
    },
    "px4_msgs/msg/VehicleGlobalPosition": {
        "1.16": _layout(_SAMPLE, _POSITION_1_16, _ERRORS),
        "1.14": _layout(_SAMPLE, _POSITION, _ERRORS),
        "1.11": _layout(_NO_SAMPLE, _POSITION, "float32 vel_n vel_e vel_d yaw", _ERRORS),
    },
    "px4_msgs/msg/VehicleOdometry": {
        "1.14": _layout(_SAMPLE, _ODOMETRY),
        "1.12": _layout(_SAMPLE, _OLD_POSE, "uint8 velocity_frame", _OLD_VELOCITY),
        "1.11": _layout(_NO_SAMPLE, _OLD_POSE, _OLD_VELOCITY),
    },
}
