from dxlrun_backlash.joint_key import STAGE as BACKLASH

from dxlrun.tooling.features import Compilation, CompileStage, Contribution


def check_backlash(compilation: Compilation) -> Contribution:
    for name, joint in compilation.joints.items():
        play, range_ = BACKLASH.value_of(joint.plan), joint.plan.upper - joint.plan.lower
        if play is not None and not 0 <= play < range_:
            mark = compilation.file.at("joints", name, "backlash")
            compilation.file.error(mark, f"the backlash of {name} is outside its range", "write less")
    return Contribution()


STAGE = CompileStage(check_backlash)
