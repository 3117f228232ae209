"""Limits of the audit. Each is our choice, with its reason; the paper prints none."""

# dynamics ---------------------------------------------------------------------------------------------------------
RESIDUAL_PERCENT = 0.5  # of m g (force) and m g * 1 m (moment): well below what landing control absorbs
TORQUE_PERCENT = 0.5  # of each joint's peak torque: as accurate as the floating base
IMPULSE_PERCENT = 0.5  # of the take-off momentum: 0.5 % of the speed is 1 % of the rise
ANGULAR_IMPULSE = 0.05  # [kg m^2/s] about 1 % of L at take-off in a forward jump
FLIGHT_COM_MM = 1.0  # from the parabola: a tenth of a percent of the jump length
FLIGHT_GRAVITY_PERCENT = 0.1  # of g, fitted to the flight: tells 9.8 from 9.81
FLIGHT_L = 0.01  # [kg m^2/s] drift of the angular momentum in flight: 1 mrad of rotation at rho = 6, 0.6 s
TAKEOFF_PERCENT = 0.5  # of m g and m g * 1 m, left over in the contact wrench at take-off
TAKEOFF_ACCELERATION_PERCENT = 0.5  # of g, between the CoM's acceleration at take-off and free fall
FLIGHT_FORCE_N = 0.1  # contact force claimed in the air: nothing but rounding
ENERGY_PERCENT = 0.5  # of the range of the mechanical energy
MASS_PERCENT = 0.5  # of the URDF's mass, against the mass that the ground force moves

# the tape itself --------------------------------------------------------------------------------------------------
STEP_MS = 1.05 + 1e-6  # the control cycle is 1 ms; touchdown falls between two, and a sliver joins the last step
QUATERNION = 1e-6  # deviation from unit length that integration cannot have caused
STEP_RATE = 0.01  # [m/s, rad/s] positions against rates, step by step: 0.1 % of the fastest joint
STEP_ACCELERATION = 4.0  # [m/s^2, rad/s^2] rates against accelerations: a jerk step of 32,000 rad/s^3 inside one step
DRIFT_POSITION = 1.0  # [mm, mrad] after re-integrating a whole phase
DRIFT_RATE = 0.01  # [m/s, rad/s] after re-integrating a whole phase
SWITCH_POSITION = 0.1  # [mm, mrad] jump between the two samples of take-off: a tenth of the slip allowed
SWITCH_RATE = 0.01  # [m/s, rad/s] likewise
SWITCH_ACCELERATION = 1.0  # [m/s^2, rad/s^2] about 1 % of the peak

# contact ----------------------------------------------------------------------------------------------------------
SLIP_MM = 1.0  # of the toe edge over the whole launch
HOVER_MM = 1.0  # of the toe edge above or below the ground while it is said to push
PENETRATION_MM = 1.0  # of any sole point below the surface under it
CLEARANCE_MM = 20.0  # of the sole in mid-flight: rough floor and tracking error of the playback
MID_FLIGHT = (0.3, 0.7)  # share of the flight: outside, the sole is on its way from or to a surface
BODY_CLEARANCE_MM = 10.0  # of everything but the feet above ground and platform
COP_MIN_FORCE_N = 50.0  # per foot (100 N in all): below, the CoP is a quotient of two small numbers
COP_OUTSIDE_MM = 10.0  # beyond the sole's edge between the planner's nodes
HEEL_UP_MM = 5.0  # heel height from which the foot counts as tipped
TOE_COP_MM = 10.0  # from CoP to toe edge while the heel is up
FRICTION = 0.5  # lowest friction that the simulations use
FRICTION_MIN_FORCE_N = 10.0  # per foot: below, the ratio is taken to this force instead
TORSION_ARM_M = 0.05  # half width of a sole: lever of the friction that resists turning on the spot
PULL_N = 1.0  # the ground cannot pull: rounding only

# joints -----------------------------------------------------------------------------------------------------------
RANGE_MRAD = 1.0  # beyond a joint's range: overshoot between nodes at most
SHARE_PERCENT = 100.0  # of a speed or torque limit
TORQUE_FLOOR = 0.01  # of the peak torque: what counts as available at the speed limit, so that shares stay finite
SYMMETRY_MRAD = 0.1  # between left and right, and of roll and yaw [mrad], of lateral shift [mm]
SYMMETRY_TORQUE_PERCENT = 0.1  # of peak torque and of body weight, between left and right

# target -----------------------------------------------------------------------------------------------------------
DISTANCE_MM = 5.0  # a tenth of what the simulated jump may miss
RISE_MM = 5.0  # a sixth of what the simulated jump may miss
FLAT_MRAD = 10.0  # sole against the surface at touchdown: 2.4 mm over its length
TOUCHDOWN_MM = 1.0  # sole corners from the surface at touchdown, as for penetration
ROTATION_MRAD = 20.0  # of the feet over the whole jump, from the asked turns: flatness at both ends
START_RATE = 0.01  # [m/s, rad/s] of anything at t = 0: the jump starts from standing

# collision --------------------------------------------------------------------------------------------------------
SELF_DISTANCE_MM = 1.0  # between links that are not neighbours: the contact margin of physics engines
SOLE_MM = 0.1  # between the sole in the URDF and the one in the robot's configuration
