// SPDX-License-Identifier: Apache-2.0
// A driver in C++: answers each frame of a simulator by the paper's equations 1 (proportional part) and 2.
// No test builds it, as the ROS wheels have no rclcpp: tried by hand, see docs/drivers.md.
#include <algorithm>
#include <memory>

#include <ds_interfaces/msg/drive_command.hpp>
#include <ds_interfaces/msg/vehicle_state.hpp>
#include <rclcpp/rclcpp.hpp>

using ds_interfaces::msg::DriveCommand;
using ds_interfaces::msg::VehicleState;

class Driver : public rclcpp::Node {
 public:
  Driver() : Node("cpp_driver") {
    commands_ = create_publisher<DriveCommand>("drive", 1);
    states_ = create_subscription<VehicleState>("state", 1, [this](const VehicleState& state) {
      DriveCommand command;
      command.header = state.header;  // lock-step takes the answer to this frame only
      command.steering = std::clamp(-0.6 * state.preview_lateral_position, -1.0, 1.0);  // position right: steer left
      const double share = state.speed / (30.0 / 3.6);
      command.throttle = std::clamp(1.0 - command.steering * command.steering - share * share, 0.0, 1.0);
      commands_->publish(command);
    });
  }

 private:
  rclcpp::Publisher<DriveCommand>::SharedPtr commands_;
  rclcpp::Subscription<VehicleState>::SharedPtr states_;
};

int main(int argc, char** argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Driver>());
  rclcpp::shutdown();
}
