# The robot tasks by the name that experiments have: sourced by study_robots.sh and study_thinking.sh.
# shellcheck disable=SC2034  # used where it is sourced
declare -A names=([lift]=Lift [stack]=Stack [pickplacecan]=PickPlaceCan [door]=Door [stackthreecubes]=StackThreeCubes
    [nutassemblysquare]=NutAssemblySquare [stackcolor]=StackColor)
