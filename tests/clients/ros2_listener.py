"""Runs where ROS 2 is: listens to a tag's topics, and writes what came as one JSON object. Not a test itself."""

import json
import sys
import time

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import NavSatFix
from visualization_msgs.msg import MarkerArray


def stamp(message):
    return [message.header.stamp.sec, message.header.stamp.nanosec]


def xyz(vector):
    return [vector.x, vector.y, vector.z]


class Listener(Node):
    def __init__(self, count):
        super().__init__("listener")
        self.count = count
        self.found = {"pose": [], "velocity": [], "fix": [], "anchors": []}
        usual = QoSProfile(depth=100)
        lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        subscribe = self.create_subscription
        subscribe(PoseWithCovarianceStamped, "/skyless/tag1/pose", self.on_pose, usual)
        subscribe(TwistWithCovarianceStamped, "/skyless/tag1/velocity", self.on_velocity, usual)
        subscribe(NavSatFix, "/skyless/tag1/fix", self.on_fix, qos_profile_sensor_data)
        subscribe(MarkerArray, "/skyless/anchors", self.on_anchors, lasting)

    def on_pose(self, one):
        where = one.pose.pose
        self.found["pose"].append([stamp(one), one.header.frame_id, xyz(where.position), one.pose.covariance.tolist()])
        if len(self.found["pose"]) % 25 == 1:
            print("a pose", file=sys.stderr, flush=True)

    def on_velocity(self, one):
        speed = one.twist
        self.found["velocity"].append([stamp(one), xyz(speed.twist.linear), speed.covariance.tolist()])

    def on_fix(self, one):
        where = [one.latitude, one.longitude, one.altitude]
        self.found["fix"].append([stamp(one), one.status.status, where, one.position_covariance.tolist()])

    def on_anchors(self, one):
        self.found["anchors"].append([[marker.type, marker.id, *xyz(marker.pose.position)] for marker in one.markers])

    def done(self):
        return len(self.found["pose"]) >= self.count and self.found["anchors"] and self.found["fix"]


def main():
    count, patience_s = int(sys.argv[1]), float(sys.argv[2])
    rclpy.init()
    node = Listener(count)
    print("listening", file=sys.stderr, flush=True)
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s and not node.done():
        rclpy.spin_once(node, timeout_sec=0.2)
    publishers = [
        {
            "node": one.node_name,
            "type": one.topic_type,
            "hash": str(one.topic_type_hash),
            "reliability": one.qos_profile.reliability.name,
        }
        for one in node.get_publishers_info_by_topic("/skyless/tag1/pose")
    ]
    print(json.dumps({**node.found, "publishers": publishers}))
    rclpy.shutdown()


if __name__ == "__main__":
    main()
